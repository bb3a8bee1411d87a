"""Fixed-count solvers of the simulator's symmetric systems on a grid of columns.

The matrix couples each cell to its 6 neighbours; every column ends in air, so the vertical
direction is stiff and short, and a line solve along z is the preconditioner of choice. No solver
stops early: the same numbers come out on every machine and under vmap, divisions are guarded, and
the residual is returned.
"""

import jax
import jax.numpy as jnp

from jaxbrush.structs import state

TINY = 1e-20


@state
class Matrix:
    """diagonal, and x, y, z: minus the coupling to the next cell along each axis (>= 0; the last
    is 0). All (z, ..., y, x), z first so that lines along z are scanned without a transpose;
    positive definite."""

    diagonal: jax.Array
    x: jax.Array
    y: jax.Array
    z: jax.Array


def _next(a, axis):
    """Value of the next cell along an axis, 0 past the end."""
    pad = [(0, 0, 0)] * a.ndim
    pad[axis] = (-1, 1, 0)
    return jax.lax.pad(a, jnp.zeros((), a.dtype), pad)


def _last(a, axis):
    """Value of the cell before along an axis, 0 before the start."""
    pad = [(0, 0, 0)] * a.ndim
    pad[axis] = (1, -1, 0)
    return jax.lax.pad(a, jnp.zeros((), a.dtype), pad)


def apply(matrix: Matrix, a):
    """The matrix times a."""
    n = a.ndim
    out = matrix.diagonal * a
    for axis, c in ((n - 1, matrix.x), (n - 2, matrix.y), (0, matrix.z)):
        out = out - c * _next(a, axis) - _last(c * a, axis)
    return out


def _line_factors(matrix: Matrix):
    """Forward elimination along z, z first: (1 / pivot, coupling / pivot)."""
    diagonal, coupling = matrix.diagonal, matrix.z

    def down(carry, inputs):
        before, ratio = carry
        d, c = inputs
        inverse = 1.0 / (d - before * ratio)
        ratio = c * inverse
        return (c, ratio), (inverse, ratio)

    zero = jnp.zeros_like(diagonal[0])
    _, factors = jax.lax.scan(down, (zero, zero), (diagonal, coupling))
    return coupling, *factors


def line_solve(factors, rhs):
    """Solves the part of the matrix along z, (z, ..., y, x)."""
    coupling, inverse, ratio = factors

    def down(carry, inputs):
        value, before = carry
        r, inverse, c = inputs
        value = (r + before * value) * inverse
        return (value, c), value

    def up(value, inputs):
        y, ratio = inputs
        value = y + ratio * value
        return value, value

    zero = jnp.zeros_like(rhs[0])
    _, y = jax.lax.scan(down, (zero, zero), (rhs, inverse, coupling))
    _, x = jax.lax.scan(up, zero, (y, ratio), reverse=True)
    return x


def _dot(a, b):
    return jnp.sum(a * b, axis=(0, a.ndim - 2, a.ndim - 1), keepdims=True)


def pcg(matrix: Matrix, rhs, iterations: int, line: bool = True):
    """Conjugate gradients, preconditioned along z (`line`) or by the diagonal.

    Returns:
      (solution, relative residual (...,)).
    """
    if line:
        factors = _line_factors(matrix)
        precondition = lambda r: line_solve(factors, r)  # noqa: E731
    else:
        precondition = lambda r: r / matrix.diagonal  # noqa: E731

    def step(_, carry):
        x, r, p, rho = carry
        q = apply(matrix, p)
        curve = _dot(p, q)
        alpha = jnp.where(curve > TINY, rho / jnp.maximum(curve, TINY), 0.0)
        x, r = x + alpha * p, r - alpha * q
        z = precondition(r)
        after = _dot(r, z)
        beta = jnp.where(rho > TINY, after / jnp.maximum(rho, TINY), 0.0)
        return x, r, z + beta * p, after

    z = precondition(rhs)
    start = (jnp.zeros_like(rhs), rhs, z, _dot(rhs, z))
    x, r, _, _ = jax.lax.fori_loop(0, iterations, step, start)
    return x, _relative(r, rhs)


def _relative(residual, rhs):
    size = jnp.sqrt(_dot(rhs, rhs))
    return (jnp.sqrt(_dot(residual, residual)) / jnp.maximum(size, TINY))[0, ..., 0, 0]


def chebyshev(matrix: Matrix, rhs, iterations: int, least: float = 0.05):
    """Chebyshev iteration over the line preconditioner: no dot products.

    The preconditioned spectrum lies in (0, 2); `least` bounds it from below.
    """
    factors = _line_factors(matrix)
    middle, radius = 0.5 * (2.0 + least), 0.5 * (2.0 - least)

    def step(k, carry):
        x, r, p, alpha = carry
        z = line_solve(factors, r)
        beta = jnp.where(k == 0, 0.0, jnp.where(k == 1, 0.5, 0.25) * (radius * alpha) ** 2)
        alpha = jnp.where(k == 0, 1.0 / middle, 1.0 / (middle - beta / alpha))
        p = z + beta * p
        x = x + alpha * p
        return x, r - alpha * apply(matrix, p), p, alpha

    one = jnp.ones((), rhs.dtype)
    x, r, _, _ = jax.lax.fori_loop(
        0, iterations, step, (jnp.zeros_like(rhs), rhs, jnp.zeros_like(rhs), one)
    )
    return x, _relative(r, rhs)


def fixed_point(matrix: Matrix, rhs, iterations: int):
    """WetBrush's scheme: two Jacobi sweeps on what the pressures so far leave of the right-hand
    side, added up. One Fourier mode with Jacobi eigenvalue l leaves l^K T_K(l) after K rounds."""

    def jacobi(x, r):
        return x + (r - apply(matrix, x)) / matrix.diagonal

    def step(_, carry):
        x, r, pressure = carry
        pressure = jacobi(jacobi(pressure, r), r)
        x = x + pressure
        return x, rhs - apply(matrix, x), pressure

    zero = jnp.zeros_like(rhs)
    x, r, _ = jax.lax.fori_loop(0, iterations, step, (zero, rhs, zero))
    return x, _relative(r, rhs)


def solve(solver: str, matrix: Matrix, rhs, iterations: int):
    """(solution, relative residual) by the solver of that name."""
    if solver == "chebyshev":
        return chebyshev(matrix, rhs, iterations)
    if solver == "fixed_point":
        return fixed_point(matrix, rhs, iterations)
    return pcg(matrix, rhs, iterations, line=solver == "zline_pcg")
