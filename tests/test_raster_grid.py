"""Where maps are drawn: windows of few sizes, on whole pixels, around all that is touched."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from raster_cases import make_track, moved, padded, random_track, reference

from jaxbrush.raster import PIXEL, bucket, dilate, make_grid, stroke_grid
from jaxbrush.raster.grid import BUCKETS
from jaxbrush.stylus import random_stroke

WIDTH = 0.3
jit_dilate = jax.jit(dilate, static_argnums=1)
strokes_of = jax.jit(jax.vmap(random_stroke))


def test_buckets():
    for size in (0, 1, 63, 64, 65, 96, 97, 1999, 2048):
        side = bucket(size)
        assert side in BUCKETS and side >= size
        assert not any(size <= other < side for other in BUCKETS), "a smaller one holds it"
    with pytest.raises(ValueError, match="2049 pixels"):
        bucket(2049)


def test_make_grid():
    grid = make_grid((3, 5), (1.0, -2.0), 0.25)
    assert grid.shape == (3, 5) and grid.pixel == 0.25
    np.testing.assert_array_equal(grid.origin, [1.0, -2.0])
    assert make_grid((3, 5)).pixel == PIXEL
    assert len(jax.tree.leaves(grid)) == 1, "only the origin is traced"


@pytest.mark.parametrize(
    "arguments, words",
    [
        (((0, 5),), r"shape = \(0, 5\)"),
        (((5, -1),), r"shape = \(5, -1\)"),
        (((5, 5), (0.0, 0.0, 0.0)), r"origin has shape \(3,\)"),
        (((5, 5), 0.0), r"origin has shape \(\)"),
        (((5, 5), (0.0, 0.0), 0.0), "pixel = 0.0"),
        (((5, 5), (0.0, 0.0), -0.1), "pixel = -0.1"),
        (((5, 5), (0.0, 0.0), float("nan")), "pixel = nan"),
    ],
)
def test_make_grid_errors(arguments, words):
    with pytest.raises(ValueError, match=words):
        make_grid(*arguments)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("pixel", [0.1, 0.125])
def test_stroke_grid_holds_all_that_is_touched(seed, pixel):
    margin = (4, 1, 0, 7)[seed]
    by = np.array([(0.0, 0.0), (100.05, -33.3), (-7.77, 512.0), (0.013, 0.021)][seed])
    track = moved(random_track(seed, stamps=12, bristles=4, size=3.0), by)
    grid = stroke_grid(padded(track, 20, 5), WIDTH, pixel, margin)
    assert all(side in BUCKETS for side in grid.shape)
    whole = np.asarray(grid.origin, float) / pixel
    assert np.abs(whole - np.round(whole)).max() < 1e-3
    # On a canvas that is much larger, nothing lies outside the window, nor in its margin.
    around = 30
    large = make_grid(
        (grid.shape[0] + 2 * around, grid.shape[1] + 2 * around),
        (np.round(whole) - around) * pixel, pixel,
    )  # fmt: skip
    touched = reference(large, track, WIDTH).bristle >= 0
    free = around + margin
    assert touched[free:-free, free:-free].sum() == touched.sum() > 50


def test_stroke_grid_is_on_the_canvas_pixels():
    # Two strokes draw on the same pixels: their windows are whole pixels apart.
    track = random_track(0, stamps=12)
    first = stroke_grid(track, WIDTH)
    second = stroke_grid(moved(track, (3.14, 2.72)), WIDTH)
    assert first.shape == second.shape
    apart = np.asarray(second.origin - first.origin, float) / PIXEL
    np.testing.assert_allclose(apart, np.round(apart), atol=1e-3)
    np.testing.assert_allclose(apart * PIXEL, [3.14, 2.72], atol=2 * PIXEL)


def test_stroke_grid_looks_only_at_touch():
    path = np.array([[1.0, 1.0], [2.0, 1.0], [90.0, 70.0], [95.0, 70.0], [95.0, 75.0]])
    force = np.array([100.0, 100.0, 0.0, 0.0, 0.0])[:, None]
    # It lifts off on its way to the third stamp, where it may still touch; the rest is in the air.
    grid = stroke_grid(make_track(path[:2]), WIDTH)
    assert grid.shape == (64, 64)
    lifting = stroke_grid(make_track(path, force, height=1.0), WIDTH)
    assert lifting.shape == (bucket(700 + 11), bucket(900 + 11))
    high = path.copy()
    high[2] = [2.5, 1.0]
    assert stroke_grid(make_track(high, force, height=1.0), WIDTH).shape == (64, 64)
    # Nothing touches: one small window, whatever the path.
    empty = stroke_grid(make_track(path, 0.0, height=1.0), WIDTH)
    assert empty.shape == (64, 64)
    np.testing.assert_array_equal(empty.origin, [0.0, 0.0])
    with pytest.raises(ValueError, match="expected at most 2048"):
        stroke_grid(make_track(4.0 * path), WIDTH)


@pytest.mark.slow
def test_a_session_has_few_shapes(key):
    strokes = strokes_of(jax.random.split(key, 30))
    compiled, exact = set(), set()
    for path, valid in zip(np.asarray(strokes.position), np.asarray(strokes.valid), strict=True):
        path = path[valid]
        off = np.array([[-3.0, 0.0, 3.0], [0.5, -0.5, 0.0]])
        grid = stroke_grid(make_track(path[:, :, None] + off[None]), WIDTH)
        # What jit looks a compiled function up by, beside the type of the origin.
        compiled.add((jax.tree.structure(grid), grid.origin.dtype))
        exact.add(tuple(np.ceil((path.max(0) - path.min(0)) / PIXEL).astype(int)))
    print(f"30 strokes: {len(compiled)} shapes, {len(exact)} without buckets")
    assert len(compiled) <= 8 and len(exact) > 20


def squares(mask, radius):
    """Maximum over a square around each pixel, by loops."""
    h, w = mask.shape
    out = np.zeros_like(mask)
    for y in range(h):
        for x in range(w):
            near = mask[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1]
            out[y, x] = near.max()
    return out


@pytest.mark.parametrize("radius", [0, 1, 3, 40])
def test_dilate_is_the_largest_in_a_square(radius):
    rng = np.random.default_rng(radius)
    mask = rng.random((13, 9)) < 0.03
    mask[12, 8] = True
    np.testing.assert_array_equal(jit_dilate(jnp.asarray(mask), radius), squares(mask, radius))
    share = np.where(mask, rng.random(mask.shape), 0.0).astype(np.float32)
    np.testing.assert_array_equal(jit_dilate(jnp.asarray(share), radius), squares(share, radius))


def test_dilate_grows():
    mask = jnp.asarray(np.random.default_rng(1).random((13, 9)) < 0.02).at[6, 4].set(True)
    before = np.zeros(mask.shape, bool)
    for radius in (0, 1, 3, 40):
        grown = np.asarray(jit_dilate(mask, radius))
        assert grown.dtype == bool and np.all(grown >= before)
        before = grown
    assert before.all()
    more = mask.at[0, 0].set(True)
    assert np.all(np.asarray(jit_dilate(more, 3)) >= np.asarray(jit_dilate(mask, 3)))
    assert not np.any(dilate(jnp.zeros((3, 4), bool), 1))
    with pytest.raises(ValueError, match="radius = -1"):
        dilate(mask, -1)


def test_dilate_takes_batches_and_slopes():
    batch = jnp.asarray(np.random.default_rng(2).random((2, 13, 9)), jnp.float32)
    got = jax.jit(jax.vmap(lambda x: dilate(x, 2)))(batch)
    for k in range(2):
        np.testing.assert_array_equal(got[k], jit_dilate(batch[k], 2))
    slope = jax.jit(jax.grad(lambda x: jnp.sum(dilate(x, 2))))(batch[0])
    # Each of the pixels hands its slope of 1 to the one it took its value from.
    assert float(jnp.sum(slope)) == pytest.approx(13 * 9)
