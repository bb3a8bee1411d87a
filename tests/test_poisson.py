"""Poisson blend: what it keeps, what it removes, and that one solve is exact."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbrush import patches, poisson, seams

OPTIONS = patches.PatchConfig(size=24, overlap=8)
BOX = patches.Box(first=jnp.asarray([0, 0], jnp.int32), cells=(2, 2))
SIDE = 2 * OPTIONS.step + OPTIONS.overlap
pick = jax.jit(patches.layout, static_argnums=3)
FULL = pick(OPTIONS, BOX, jnp.ones((SIDE, SIDE)), 16)


def picture(seed=0, channels=2, rough=1.0):
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:SIDE, :SIDE] / SIDE
    smooth = np.sin(5 * x + 2 * y)[..., None] * rng.normal(size=(1, 1, channels))
    return jnp.asarray(smooth + rough * rng.normal(size=(SIDE, SIDE, channels)), jnp.float32)


def cut(field, layout=FULL):
    return patches.cut(OPTIONS, BOX, field, layout.corner)


def whole(tiles, layout=FULL):
    """Tiles as a picture of a canvas; the box begins `overlap` before it."""
    empty = jnp.zeros((2 * OPTIONS.step, 2 * OPTIONS.step, tiles.shape[-1]))
    return patches.place(tiles, layout, empty)


def _blends(given, layout):
    return {
        "cut": whole(patches.merge(OPTIONS, given, layout, sharp=True), layout),
        "feather": whole(patches.merge(OPTIONS, given, layout), layout),
        "poisson": whole(poisson.merge(OPTIONS, given, layout), layout),
    }


# One for all tests: op by op every operation would compile.
blends = jax.jit(_blends)
cut_all = jax.jit(cut)


def shifted(layout=FULL, seed=1):
    """An offset for each patch."""
    count = layout.corner.shape[0]
    return jnp.asarray(np.random.default_rng(seed).normal(size=(count, 1, 1, 2)), jnp.float32)


def dense(h, w, free):
    """The five-point stencil as a matrix."""

    def line(n, low, high):
        m = np.diag(np.full(n, -2.0)) + np.eye(n, k=1) + np.eye(n, k=-1)
        m[0, 0] += low
        m[-1, -1] += high
        return m

    return np.kron(line(h, *free[:2]), np.eye(w)) + np.kron(np.eye(h), line(w, *free[2:]))


@pytest.mark.parametrize("shape", [(7, 12), (1, 5)])
def test_a_solve_is_that_of_the_dense_matrix(shape):
    rng = np.random.default_rng(0)
    source = rng.normal(size=(16, *shape, 2)).astype(np.float32)
    free = np.array([[bool(k & 1 << bit) for bit in range(4)] for k in range(16)])
    found = np.asarray(jax.jit(poisson.solve)(jnp.asarray(source), jnp.asarray(free)))
    assert np.all(np.isfinite(found))
    for k in range(16):
        matrix = dense(*shape, free[k])
        right = source[k].reshape(-1, 2).astype(np.float64)
        want = np.linalg.lstsq(matrix, right - right.mean(0) * free[k].all(), rcond=None)[0]
        np.testing.assert_allclose(found[k].reshape(-1, 2), want, atol=2e-4)
    # Four free sides: the mean of the source is nobody's, and that of the result is 0.
    np.testing.assert_allclose(found[15].mean((0, 1)), 0.0, atol=1e-5)
    held = jax.jit(poisson.solve)(jnp.asarray(source[:1]))
    np.testing.assert_allclose(held[0], found[0], atol=1e-5)


def test_patches_that_agree_are_unchanged():
    field = picture()
    found = blends(cut_all(field, FULL), FULL)["poisson"]
    over = OPTIONS.overlap
    np.testing.assert_allclose(found, field[over:, over:], atol=2e-6)


def test_a_constant_offset_is_spread_over_the_overlap():
    """Of any picture, and exactly: the result is the picture and a fade between the offsets."""
    field, offset = picture(), shifted()
    found = blends(cut_all(field, FULL) + offset, FULL)["poisson"]
    fade = blends(jnp.broadcast_to(offset, (16, 24, 24, 2)), FULL)["feather"]
    over = OPTIONS.overlap
    np.testing.assert_allclose(found, field[over:, over:] + fade, atol=1e-5)


def test_unrelated_patches_blend_without_a_seam():
    """Steps are in between those of the patches, up to the offset that has to be spread."""
    noise = np.random.default_rng(2).normal(size=(FULL.corner.shape[0], 24, 24, 2))
    side = 2 * OPTIONS.step
    mask = np.zeros((side, side), np.float32)
    mask[: -OPTIONS.overlap // 2, : -OPTIONS.overlap // 2] = 1.0  # all cores
    measure = jax.jit(lambda *x: jnp.max(seams.seam(OPTIONS, *x, mask)))
    for offset in (0.0, 1.0):
        given = jnp.asarray(0.02 * noise, jnp.float32) + offset * shifted()
        found = {name: float(measure(given, FULL, x)) for name, x in blends(given, FULL).items()}
        print(offset, found)
        assert found["cut"] > 1.5 * max(found["feather"], found["poisson"])
    # Patches that agree have none, however rough.
    given = cut_all(picture(rough=3.0), FULL)
    for found in blends(given, FULL).values():
        assert measure(given, FULL, found) < 1e-5


@pytest.mark.parametrize("gone", [0, 1, 2, 3])
def test_a_patch_that_is_not_painted_leaves_no_trace(gone):
    """The patches around it reach into its place; what it holds itself is never read."""
    mask = np.zeros((SIDE, SIDE))
    half, step = OPTIONS.overlap // 2, OPTIONS.step
    y, x = divmod(gone, 2)
    mask[half:-half, half:-half] = 1.0
    mask[half + y * step : half + (y + 1) * step, half + x * step : half + (x + 1) * step] = 0.0
    layout = pick(OPTIONS, BOX, jnp.asarray(mask, jnp.float32), 16)
    assert int(layout.present.sum()) == 3
    field = picture()
    given = jnp.where(layout.present[:, None, None, None], cut_all(field, layout), 1e9)
    found = np.asarray(blends(given, layout)["poisson"])
    inside = mask[OPTIONS.overlap :, OPTIONS.overlap :] > 0.0
    want = np.asarray(field)[OPTIONS.overlap :, OPTIONS.overlap :]
    np.testing.assert_allclose(found[inside], want[inside], atol=2e-6)


def test_slope_is_that_of_finite_differences():
    weights = picture(4)[OPTIONS.overlap :, OPTIONS.overlap :]
    given, way = cut_all(picture(), FULL) + shifted(), shifted(seed=5) * cut_all(picture(6), FULL)

    @jax.jit
    @jax.value_and_grad
    def cost(patch):
        return jnp.sum(weights * whole(poisson.merge(OPTIONS, patch, FULL)) ** 2)

    slope = np.vdot(cost(given)[1], way)
    step = 1e-2
    ahead, behind = (cost(given + sign * step * way)[0] for sign in (1.0, -1.0))
    np.testing.assert_allclose((ahead - behind) / (2.0 * step), slope, rtol=5e-3)
