"""The simulator's parts: solvers against dense algebra, fluxes that conserve, columns repacked."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbrush.paint import PaintConfig, make_params, velocity
from jaxbrush.paint.advection import advect, repack, slump
from jaxbrush.paint.hair import Hair
from jaxbrush.paint.solvers import Matrix, apply, diagonal, residual, solve
from jaxbrush.paint.state import BrushPaint
from jaxbrush.paint.stencil import near, wide
from jaxbrush.paint.transfer import transfer
from jaxbrush.paint.velocity import divergence, faces_of, flow, project, viscous

SIDE = 8
SHAPE = (5, SIDE * SIDE)
CONFIG = PaintConfig(layers=5, window=SIDE, pigments=3)


def columns(seed=0):
    """A bumpy film: full cells, one partly filled on top, air above; the brush's share phi."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.5, SHAPE[0] - 1.2, SHAPE[1:])
    level = np.arange(SHAPE[0])[:, None]
    return np.clip(depth[None] - level, 0.0, 1.0), 0.4 * rng.uniform(size=SHAPE) * (level < 2)


def matrix_of(seed=1):
    rng = np.random.default_rng(seed)
    link = jnp.asarray(rng.uniform(0.1, 1.0, SHAPE))
    return Matrix(wide(link, SIDE), jnp.full(SHAPE, 0.3), ratio=4.0, width=SIDE)


def dense(matrix):
    """Written out from what `Matrix` says, cell by cell."""
    link = np.asarray(near(matrix.link, SIDE)).reshape(SHAPE[0], SIDE, SIDE)
    number = np.arange(link.size).reshape(link.shape)
    a = np.diag(np.asarray(matrix.extra).ravel())
    for cell in np.ndindex(link.shape):
        for axis in range(3):
            other = tuple(c + (k == axis) for k, c in enumerate(cell))
            if other[axis] < link.shape[axis]:
                c = min(link[cell], link[other]) * (matrix.ratio if axis == 0 else 1.0)
                i, j = number[cell], number[other]
                a[i, i] += c
                a[j, j] += c
                a[i, j] -= c
                a[j, i] -= c
    return a


def inside(x):
    return np.asarray(x)[..., SIDE:-SIDE]


def test_the_matrix_is_what_it_says(x64):
    matrix = matrix_of()
    a = dense(matrix)
    x = np.random.default_rng(3).normal(size=(SHAPE[0], 2, SHAPE[1]))
    want = np.einsum("ij,cj->ci", a, x.transpose(1, 0, 2).reshape(2, -1))
    have = np.asarray(apply(matrix, jnp.asarray(x))).transpose(1, 0, 2).reshape(2, -1)
    np.testing.assert_allclose(have, want, atol=1e-12)
    np.testing.assert_allclose(np.asarray(diagonal(matrix)).ravel(), np.diag(a), atol=1e-12)


@pytest.mark.parametrize(
    "solver, iterations, bound",
    [("zline_pcg", 60, 1e-9), ("jacobi_pcg", 150, 1e-9), ("chebyshev", 121, 1e-6),
     ("fixed_point", 400, 1e-6)],
)  # fmt: skip
def test_solvers_agree_with_dense_algebra(x64, solver, iterations, bound):
    matrix = matrix_of()
    a = dense(matrix)
    rhs = np.random.default_rng(2).normal(size=(SHAPE[0], 1, SHAPE[1]))
    exact = np.linalg.solve(a, rhs.ravel()).reshape(rhs.shape)
    x = inside(solve(solver, matrix, jnp.asarray(rhs), iterations))
    left = float(residual(matrix, jnp.asarray(x), jnp.asarray(rhs))[0])
    error = np.abs(x - exact).max() / np.abs(exact).max()
    print(f"{solver}: error {error:.1e}, residual {left:.1e} after {iterations}")
    assert error < bound
    assert left < 10.0 * bound


def test_lines_converge_faster_than_the_diagonal(x64):
    matrix = matrix_of()
    rhs = jnp.asarray(np.random.default_rng(2).normal(size=(SHAPE[0], 1, SHAPE[1])))
    left = lambda solver: residual(matrix, inside(solve(solver, matrix, rhs, 8)), rhs)  # noqa: E731
    assert float(left("zline_pcg")[0]) < 0.3 * float(left("jacobi_pcg")[0])


@pytest.mark.parametrize("radius", [0.3, 0.7, 0.9, 0.99])
def test_no_guess_of_the_spectrum_makes_chebyshev_diverge(x64, radius):
    matrix = matrix_of()
    rhs = jnp.asarray(np.random.default_rng(2).normal(size=(SHAPE[0], 1, SHAPE[1])))
    left = [
        float(residual(matrix, inside(solve("chebyshev", matrix, rhs, k, radius)), rhs)[0])
        for k in (4, 20, 100)
    ]
    assert left[2] < 0.1 * left[0] and left[2] < left[1] * 1.5


@pytest.mark.parametrize("solver", ["zline_pcg", "jacobi_pcg", "chebyshev", "fixed_point"])
def test_solvers_survive_an_empty_right_hand_side(solver):
    matrix = jax.tree.map(lambda a: a.astype(jnp.float32), matrix_of())
    x = solve(solver, matrix, jnp.zeros((SHAPE[0], 1, SHAPE[1]), jnp.float32), 30)
    assert np.all(np.asarray(x) == 0.0)


def test_fixed_point_leaves_what_its_closed_form_says(x64):
    # One full row along x with a constant diagonal: every eigenvector is one of Jacobi's. The
    # links of the first and last cell make up for the neighbour they lack.
    n = 16
    link = wide(jnp.ones((1, n)), n)
    extra = jnp.full((1, n), 0.2).at[0, 0].add(1.0).at[0, -1].add(1.0)
    matrix = Matrix(link, extra, ratio=1.0, width=n)
    rows = jax.vmap(lambda e: apply(matrix, e.reshape(1, 1, n)).ravel())(jnp.eye(n))
    values, vectors = np.linalg.eigh(np.asarray(rows))
    for rounds in (1, 3, 6):
        fixed_point = jax.jit(lambda rhs, k=rounds: solve("fixed_point", matrix, rhs, k))
        for which in (0, 5, n - 1):
            rhs = jnp.asarray(vectors[:, which].reshape(1, 1, n))
            jacobi = 1.0 - values[which] / 2.2
            left = float(residual(matrix, fixed_point(rhs)[..., n:-n], rhs)[0])
            want = jacobi**rounds * np.polynomial.chebyshev.Chebyshev.basis(rounds)(jacobi)
            assert left == pytest.approx(abs(want), rel=1e-6, abs=1e-12)


def wall(axis):
    """1 on the faces along x, y or z that lie inside the box, (z, n)."""
    mask = np.ones((SHAPE[0], SIDE, SIDE))
    np.moveaxis(mask, (2, 1, 0)[axis], 0)[-1] = 0.0
    return mask.reshape(SHAPE)


def flow_of(seed=3, size=0.9, dtype=jnp.float32):
    rng = np.random.default_rng(seed)
    faces = [rng.uniform(-size, size, SHAPE) * wall(axis) for axis in range(3)]
    return [wide(jnp.asarray(f, dtype), SIDE) for f in faces]


def film(seed=0):
    fill, _ = columns(seed)
    mix = np.random.default_rng(seed + 7).dirichlet([1.0, 1.0], size=SHAPE)
    mix = np.concatenate([mix, np.zeros((*SHAPE, 1))], -1)
    return jnp.asarray(np.moveaxis(fill[..., None] * mix, -1, 1), jnp.float32)


@pytest.mark.parametrize("limiter", [False, True])
def test_advection_conserves_and_keeps_colors_in_the_hull(limiter):
    config = dataclasses.replace(CONFIG, limiter=limiter)
    paint = before = film()
    for seed in range(20):
        paint = advect(config, paint, flow_of(seed))
    np.testing.assert_allclose(
        np.asarray(paint, np.float64).sum((0, 2)),
        np.asarray(before, np.float64).sum((0, 2)),
        rtol=1e-6,
    )
    assert float(paint.min()) >= 0.0
    # The third pigment was never there.
    assert np.all(np.asarray(paint[:, 2]) == 0.0)


def test_grooves_keep_their_depth_in_a_flow_along_them_in_any_direction():
    """A film with grooves 4 cells apart flows along them, for 10 stamps by half a cell. What is
    only upwind keeps nothing of them on a diagonal, and all of them along an axis."""
    side = 32
    y, x = np.mgrid[:side, :side]

    def kept(degrees, limiter):
        config = PaintConfig(layers=2, window=side, pigments=1, limiter=limiter)
        a = np.radians(degrees)
        wave = np.cos(0.5 * np.pi * (x * -np.sin(a) + y * np.cos(a)))
        paint = np.stack([0.5 + 0.3 * wave.ravel(), 0.0 * wave.ravel()])[:, None]
        flow = [np.full((2, side * side), 0.5 * v) for v in (np.cos(a), np.sin(a), 0.0)]
        flow = [wide(jnp.asarray(f, jnp.float32), side) for f in flow]
        move = jax.jit(lambda p: jax.lax.fori_loop(0, 10, lambda _, p: advect(config, p, flow), p))
        film = np.asarray(move(jnp.asarray(paint, jnp.float32)))[0, 0].reshape(side, side)
        # What came from the sides has not reached the middle.
        inner = np.s_[12:20, 12:20]
        return np.sum(film[inner] * wave[inner]) / np.sum((0.5 + 0.3 * wave)[inner] * wave[inner])

    ours = [kept(degrees, True) for degrees in (0, 20, 45)]
    naive = [kept(degrees, False) for degrees in (0, 20, 45)]
    print("kept at 0, 20, 45 degrees:", np.round(ours, 3), "upwind only:", np.round(naive, 3))
    assert ours[0] == pytest.approx(1.0, abs=1e-3) and naive[0] == pytest.approx(1.0, abs=1e-3)
    assert min(ours) > 0.6
    assert max(naive[1:]) < 0.3


def test_clipping_a_cell_loses_what_repacking_keeps():
    paint = film()
    for seed in range(5):
        paint = advect(CONFIG, paint, flow_of(seed))
    total = float(jnp.sum(paint))
    fill = jnp.sum(paint, axis=1, keepdims=True)
    clipped = paint * jnp.minimum(1.0, 1.0 / jnp.maximum(fill, 1e-9))
    assert float(jnp.sum(clipped)) < 0.98 * total
    packed = repack(paint, jnp.ones(SHAPE))
    assert float(jnp.sum(packed)) == pytest.approx(total, rel=1e-6)
    full = np.asarray(jnp.sum(packed, axis=1))
    assert full[:-1].max() <= 1.0 + 2e-5
    # No cell but the topmost of a column is partly filled, once pulled often enough.
    for _ in range(SHAPE[0]):
        packed = repack(packed, jnp.ones(SHAPE))
    full = np.asarray(jnp.sum(packed, axis=1))
    partial = ((full > 2e-5) & (full < 1.0 - 2e-5)).sum(0)
    assert partial.max() <= 1
    np.testing.assert_allclose(full.sum(0), np.asarray(fill).sum((0, 1)), rtol=1e-5)


def test_slumping_conserves_and_lowers_only_steep_steps():
    params = make_params()
    paint = film()
    close = jnp.ones(SHAPE[1:])
    step = jnp.asarray(0.125)
    after = slump(CONFIG, params, paint, close, step)
    assert float(jnp.sum(after)) == pytest.approx(float(jnp.sum(paint)), rel=1e-6)
    assert float(after.min()) >= 0.0
    surface = lambda p: np.asarray(jnp.sum(p, axis=(0, 1))).reshape(SIDE, SIDE)  # noqa: E731
    rough = lambda p: np.abs(np.diff(surface(p), axis=1)).max()  # noqa: E731
    assert rough(after) < rough(paint)
    same = slump(CONFIG, params, paint, 0.0 * close, step)
    assert np.array_equal(np.asarray(same), np.asarray(paint))


@pytest.mark.parametrize(
    "solver, rounds", [("zline_pcg", (2, 8, 20)), ("chebyshev", (2, 8, 20, 80))]
)
def test_projection_removes_the_divergence_of_liquid(x64, solver, rounds):
    fill, phi = columns()
    fill, phi = jnp.asarray(fill), jnp.asarray(phi)
    params = make_params()
    face = flow_of(dtype=float)
    liquid = np.asarray(fill + phi >= 0.5)
    source = np.maximum(np.asarray(fill + phi) - 1.0, 0.0)
    worst, rms, spread = [], [], jax.jit(divergence, static_argnums=1)
    # (A single round of Chebyshev's leaves half of what two do.)
    for iterations in rounds:
        config = dataclasses.replace(CONFIG, solver=solver, pressure=iterations)
        moved, _ = jax.jit(project, static_argnums=0)(config, params, fill, phi, face)
        out = spread([wide(f, SIDE) for f in moved], SIDE)
        left = (np.asarray(out) - source)[liquid]
        worst.append(np.abs(left).max())
        rms.append(np.sqrt(np.mean(left**2)))
    print("divergence left, most:", [f"{v:.1e}" for v in worst], "rms", [f"{v:.1e}" for v in rms])
    assert np.all(np.diff(rms) < 0.0) and np.all(np.diff(worst) < 0.0)
    # What keeps enclosed liquid from being singular leaves 1e-6 of the pressure.
    assert worst[-1] < 1e-5


def test_drag_carries_paint_with_the_hair_and_the_canvas_holds_it(x64):
    # A slab under a bed of hair that moves by one cell along x, far from the sides.
    side = 24
    config = dataclasses.replace(CONFIG, layers=6, window=side, viscous=60, spectrum=0.95)
    params = make_params()
    fill = jnp.ones((6, side * side)).at[5].set(0.0)
    phi = jnp.zeros(fill.shape).at[4].set(0.3)
    motion = jnp.zeros((6, 3, side * side)).at[:, 0].set(1.0)
    u, left = viscous(config, params, fill, phi, motion)
    u = np.asarray(u)[..., side:-side].reshape(6, 3, side, side)
    speed = u[:, 0, 12, 12]
    assert float(left[0]) < 1e-5
    assert speed[4] > 0.5
    assert np.all(np.diff(speed[:5]) > 0.0)
    # Couette: linear between the canvas, half a cell below the first layer, and the hair.
    np.testing.assert_allclose(speed[:4] / speed[3], (np.arange(4) + 0.5) / 3.5, atol=0.06)
    # The other components stay still, and air does not move.
    assert np.abs(u[:, 1:]).max() < 1e-9 and np.abs(u[5]).max() < 1e-9
    margins = ((0, 0), (0, 0), (side, side))
    faces = faces_of(config, jnp.pad(jnp.asarray(u.reshape(6, 3, -1)), margins))
    middle = np.asarray(faces[0]).reshape(6, side, side)
    np.testing.assert_allclose(middle[:5, 12, 12], u[:5, 0, 12, 12], rtol=1e-3)
    assert np.all(middle[:, :, -1] == 0.0)


def test_what_bristles_exchange_does_not_depend_on_the_layers():
    """Four bristles, twice full so that they only exchange, in a film of 0.25 mm."""
    params = make_params(contact_area=0.02, tip_volume=0.04)
    place = jnp.asarray([[[0.3, 0.3, 0.7, 0.7]], [[0.3, 0.7, 0.3, 0.7]], [[0.02] * 4]])
    ones = jnp.ones((1, 4))
    hair = Hair(
        place=place, motion=jnp.zeros((3, 1, 4)), weight=ones, share=jnp.ones((1, 1)),
        travel=jnp.full(4, 0.1), volume=0.0 * ones, step=jnp.asarray(0.1),
    )  # fmt: skip
    gained = []
    for layers in (2, 4, 8, 16):
        config = PaintConfig(layers=layers, layer=0.5 / layers, window=SIDE, pigments=2)
        full = (jnp.arange(layers) < layers // 2).astype(float)
        paint = jnp.zeros((layers, 2, SIDE, SIDE)).at[:, 1].set(full[:, None, None])
        brush = BrushPaint(jnp.zeros((2, 4)).at[0].set(0.02), jnp.zeros((2, 4)))
        after, left = transfer(config, params, paint, brush, hair, jnp.zeros((2, SIDE, SIDE)))
        gained.append(float(left.tip[1].sum()))
        there = config.cell * float(paint.sum() - after.sum())
        assert there == pytest.approx(float(left.tip.sum()) - 0.08, abs=1e-7)
    print("taken up [mm^3]", gained)
    assert gained[0] > 1e-5
    np.testing.assert_allclose(gained, gained[0], rtol=1e-4)


def test_what_the_yield_reads_of_its_neighbours_is_stored_first(monkeypatch):
    """Else a stamp takes 1.4 times as long: XLA turns planes with margins into padding, and works
    out what it pads, here the three projected displacements, again at every offset."""
    layers, n = SHAPE
    shapes = [jax.ShapeDtypeStruct(s, jnp.float32) for s in (SHAPE, SHAPE, (layers, 3, n), ())]

    def most():
        """Padded values that one kernel computes and reads at another offset."""
        move = jax.jit(lambda params, *fields: flow(CONFIG, params, *fields))
        text, counts = move.lower(make_params(), *shapes).compile().as_text(), [0]
        for kernel in re.findall(r"^%?fused_computation[^\n]*\{\n(.*?)^\}", text, re.M | re.S):
            pads = re.findall(r"%(pad[\w.\-]*) = \S+ pad\(%(?!param|bitcast)", kernel)
            counts.append(sum(f"slice(%{pad})" in kernel for pad in pads))
        return max(counts)

    ours = most()
    monkeypatch.setattr(velocity, "stored", lambda tree, one: tree)
    assert ours < 3 <= most()
