"""The simulator's parts: solvers against dense algebra, fluxes that conserve, columns repacked."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbrush.paint import PaintConfig, make_params
from jaxbrush.paint.advection import advect, repack, slump
from jaxbrush.paint.solvers import Matrix, apply, solve
from jaxbrush.paint.velocity import AXES, divergence, project, viscous

SHAPE = (5, 7, 6)
CONFIG = PaintConfig(layers=5, window=8, pigments=3)


def columns(seed=0, shape=SHAPE):
    """A bumpy film: full cells, one partly filled on top, air above; the brush's share phi."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.5, shape[0] - 1.2, shape[1:])
    level = np.arange(shape[0])[:, None, None]
    return np.clip(depth[None] - level, 0.0, 1.0), 0.4 * rng.uniform(size=shape) * (level < 2)


def matrix_of(shape=SHAPE, seed=1):
    rng = np.random.default_rng(seed)
    couplings = []
    for axis in AXES:
        c = rng.uniform(0.1, 1.0, shape) * (4.0 if axis == -3 else 1.0)
        np.moveaxis(c, axis, 0)[-1] = 0.0
        couplings.append(c)
    diagonal = 0.3 + sum(
        c + np.concatenate([np.zeros_like(np.take(c, [0], a)),
                            np.delete(c, -1, a)], a) for c, a in zip(couplings, AXES, strict=True)
    )  # fmt: skip
    return Matrix(*(jnp.asarray(a) for a in (diagonal, *couplings)))


def dense(matrix):
    n = int(np.prod(SHAPE))
    eye = jnp.eye(n).reshape(n, *SHAPE)
    return np.asarray(jax.vmap(lambda e: apply(matrix, e))(eye)).reshape(n, n)


@pytest.mark.parametrize(
    "solver, iterations, bound",
    [("zline_pcg", 60, 1e-9), ("jacobi_pcg", 150, 1e-9), ("chebyshev", 120, 1e-6),
     ("fixed_point", 400, 1e-6)],
)  # fmt: skip
def test_solvers_agree_with_dense_algebra(x64, solver, iterations, bound):
    matrix = matrix_of()
    a = dense(matrix)
    np.testing.assert_allclose(a, a.T, atol=1e-12)
    rhs = np.random.default_rng(2).normal(size=SHAPE)
    exact = np.linalg.solve(a, rhs.ravel()).reshape(SHAPE)
    x, residual = solve(solver, matrix, jnp.asarray(rhs), iterations)
    error = np.abs(np.asarray(x) - exact).max() / np.abs(exact).max()
    print(f"{solver}: error {error:.1e}, residual {float(residual):.1e} after {iterations}")
    assert error < bound
    assert float(residual) < 10.0 * bound


def test_lines_converge_faster_than_the_diagonal(x64):
    matrix = matrix_of()
    rhs = jnp.asarray(np.random.default_rng(2).normal(size=SHAPE))
    _, line = solve("zline_pcg", matrix, rhs, 8)
    _, point = solve("jacobi_pcg", matrix, rhs, 8)
    assert float(line) < 0.3 * float(point)


@pytest.mark.parametrize("solver", ["zline_pcg", "jacobi_pcg", "chebyshev", "fixed_point"])
def test_solvers_survive_an_empty_right_hand_side(solver):
    matrix = jax.tree.map(lambda a: a.astype(jnp.float32), matrix_of())
    x, residual = solve(solver, matrix, jnp.zeros(SHAPE, jnp.float32), 30)
    assert np.all(np.asarray(x) == 0.0) and np.isfinite(float(residual))


def test_fixed_point_leaves_what_its_closed_form_says(x64):
    # On a line with a constant diagonal every eigenvector is one of Jacobi's, eigenvalue l.
    n, shape = 16, (1, 1, 16)
    coupling = jnp.ones(shape).at[..., -1].set(0.0)
    zero = jnp.zeros(shape)
    matrix = Matrix(jnp.full(shape, 2.2), coupling, zero, zero)
    rows = jax.vmap(lambda e: apply(matrix, e.reshape(shape)).ravel())(jnp.eye(n))
    values, vectors = np.linalg.eigh(np.asarray(rows))
    for which in (0, 5, n - 1):
        rhs = jnp.asarray(vectors[:, which].reshape(shape))
        jacobi = 1.0 - values[which] / 2.2
        for rounds in (1, 3, 6):
            _, left = solve("fixed_point", matrix, rhs, rounds)
            want = jacobi**rounds * np.polynomial.chebyshev.Chebyshev.basis(rounds)(jacobi)
            assert float(left) == pytest.approx(abs(want), rel=1e-6, abs=1e-12)


def flow_of(seed=3, size=0.9):
    rng = np.random.default_rng(seed)
    faces = []
    for axis in AXES:
        q = rng.uniform(-size, size, SHAPE)
        np.moveaxis(q, axis, 0)[-1] = 0.0
        faces.append(jnp.asarray(q, jnp.float32))
    return faces


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
        np.asarray(paint, np.float64).sum((0, 2, 3)),
        np.asarray(before, np.float64).sum((0, 2, 3)),
        rtol=1e-6,
    )
    assert float(paint.min()) >= 0.0
    # The third pigment was never there.
    assert np.all(np.asarray(paint[:, 2]) == 0.0)


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
    near = jnp.ones(SHAPE[1:])
    step = jnp.asarray(0.125)
    after = slump(CONFIG, params, paint, near, step)
    assert float(jnp.sum(after)) == pytest.approx(float(jnp.sum(paint)), rel=1e-6)
    assert float(after.min()) >= 0.0
    rough = lambda p: float(jnp.abs(jnp.diff(jnp.sum(p, axis=(0, 1)), axis=1)).max())  # noqa: E731
    assert rough(after) < rough(paint)
    same = slump(CONFIG, params, paint, 0.0 * near, step)
    assert np.array_equal(np.asarray(same), np.asarray(paint))


def test_projection_removes_the_divergence_of_liquid(x64):
    fill, phi = columns()
    fill, phi = jnp.asarray(fill), jnp.asarray(phi)
    params = make_params()
    face = [f.astype(float) for f in flow_of()]
    liquid = np.asarray(fill + phi >= 0.5)
    source = np.maximum(np.asarray(fill + phi) - 1.0, 0.0)
    left = []
    for iterations in (2, 10, 40):
        config = dataclasses.replace(CONFIG, pressure=iterations)
        moved, _ = project(config, params, fill, phi, face)
        left.append(np.abs(np.asarray(divergence(moved)) - source)[liquid].max())
    print(f"divergence left: {left}")
    assert left[0] > left[1] > left[2]
    assert left[2] < 1e-6


def test_drag_carries_paint_with_the_hair_and_the_canvas_holds_it(x64):
    # A slab under a bed of hair that moves by one cell along x, far from the sides.
    shape = (6, 24, 24)
    config = dataclasses.replace(CONFIG, layers=6, viscous=40)
    params = make_params()
    fill = jnp.ones(shape).at[5].set(0.0)
    phi = jnp.zeros(shape).at[4].set(0.3)
    motion = jnp.zeros((3, *shape)).at[0].set(1.0)
    face, residual = viscous(config, params, fill, phi, motion)
    speed = np.asarray(face[0])[:, 12, 12]
    assert float(residual[0]) < 1e-6
    assert speed[4] > 0.5
    assert np.all(np.diff(speed[:5]) > 0.0)
    # Couette: linear between the canvas, half a cell below the first layer, and the hair.
    np.testing.assert_allclose(speed[:4] / speed[3], (np.arange(4) + 0.5) / 3.5, atol=0.06)
    # Viscosity cancels: only the ratio of drag to viscosity is a parameter; w stays small.
    assert np.abs(np.asarray(face[2])).max() < 1e-6
