"""Fixed-count solvers of the simulator's symmetric systems on a grid of columns.

The matrix couples each cell to its 6 neighbours; every column ends in air, so the vertical
direction is stiff and short, and a line solve along z is the preconditioner of choice. No solver
stops early: the same numbers come out on every machine and under vmap, divisions are guarded, and
the residual is returned.

Unknowns are flat planes (z, c, n), n = y * x, of c systems with one matrix (see `stencil`).
"""

import dataclasses

import jax
import jax.numpy as jnp

from jaxbrush.paint.stencil import inner_x, wide
from jaxbrush.structs import state

TINY = 1e-20


@state
class Matrix:
    """(A a)_i = extra_i a_i + sum over neighbours j of c_ij (a_i - a_j).

    c_ij = min(link_i, link_j), times `ratio` between layers.

    link: (z + 2, n + 2 width), wide. extra: (z, n) > 0: then A is positive definite. Nothing
    couples over the sides of the box. width: cells along x.
    """

    link: jax.Array
    extra: jax.Array
    ratio: float = dataclasses.field(metadata={"static": True})
    width: int = dataclasses.field(metadata={"static": True})


@state
class Lines:
    """The part of a matrix along z, factored, each (z, n): inverse pivots, and what the layer
    below and the one above add."""

    inverse: jax.Array
    low: jax.Array
    high: jax.Array


def _at(planes, z, shift, width):
    """Plane z of (z, ..., n + 2 width), read from `shift` cells on: (..., n)."""
    start = (z, *[0] * (planes.ndim - 2), width + shift)
    size = (1, *planes.shape[1:-1], planes.shape[-1] - 2 * width)
    return jax.lax.dynamic_slice(planes, start, size)[0]


def _row(planes, z):
    return jax.lax.dynamic_index_in_dim(planes, z, keepdims=False)


def _sides(matrix: Matrix):
    """(shift, wall (n,) or None) of the four neighbours in a plane."""
    width, n = matrix.width, matrix.extra.shape[1]
    wall = lambda shift: jnp.asarray(  # noqa: E731
        inner_x(n // width, width, shift), matrix.link.dtype
    )
    return (1, wall(0)), (-1, wall(-1)), (width, None), (-width, None)


def _couplings(matrix: Matrix, sides, z):
    """The couplings of plane z to its four neighbours in the plane, each (n,)."""
    here = _at(matrix.link, z + 1, 0, matrix.width)
    for shift, wall in sides:
        c = jnp.minimum(here, _at(matrix.link, z + 1, shift, matrix.width))
        yield shift, c if wall is None else c * wall


def _up(matrix: Matrix, z):
    """The coupling of plane z to the next, (n,)."""
    here, above = (_at(matrix.link, z + k, 0, matrix.width) for k in (1, 2))
    return matrix.ratio * jnp.minimum(here, above)


def lines_of(matrix: Matrix) -> Lines:
    """Eliminates along z."""
    sides = _sides(matrix)

    def down(carry, z):
        before, ratio = carry
        next_ = _up(matrix, z)
        diagonal = _row(matrix.extra, z) + before + next_
        diagonal = diagonal + sum(c for _, c in _couplings(matrix, sides, z))
        inverse = 1.0 / (diagonal - before * ratio)
        return (next_, next_ * inverse), (inverse, before * inverse, next_ * inverse)

    zero = jnp.zeros_like(matrix.extra[0])
    _, factors = jax.lax.scan(down, (zero, zero), jnp.arange(matrix.extra.shape[0]))
    return Lines(*factors)


def line_solve(lines: Lines, rhs):
    """Solves the part of the matrix along z."""

    def down(value, inputs):
        r, inverse, low = inputs
        value = r * inverse + low * value
        return value, value

    def up(value, inputs):
        y, high = inputs
        value = y + high * value
        return value, value

    zero = jnp.zeros_like(rhs[0])
    each = lambda a: a[:, None]  # noqa: E731
    _, y = jax.lax.scan(down, zero, (rhs, each(lines.inverse), each(lines.low)))
    _, x = jax.lax.scan(up, zero, (y, each(lines.high)), reverse=True)
    return x


def apply(matrix: Matrix, a):
    """The matrix times a, (z, c, n)."""
    sides, width = _sides(matrix), matrix.width
    x = wide(a, width)

    def plane(_, z):
        own = _at(x, z + 1, 0, width)
        out = _row(matrix.extra, z)[None] * own
        for shift, c in _couplings(matrix, sides, z):
            out = out + c[None] * (own - _at(x, z + 1, shift, width))
        for below, dz in ((z - 1, 0), (z, 2)):
            # Below the first plane lies the margin, which couples to nothing.
            c = _up(matrix, below)
            out = out + c[None] * (own - _at(x, z + dz, 0, width))
        return None, out

    return jax.lax.scan(plane, None, jnp.arange(a.shape[0]))[1]


def diagonal(matrix: Matrix):
    """(z, n)."""
    sides = _sides(matrix)

    def plane(before, z):
        next_ = _up(matrix, z)
        own = _row(matrix.extra, z) + before + next_
        return next_, own + sum(c for _, c in _couplings(matrix, sides, z))

    layers = jnp.arange(matrix.extra.shape[0])
    return jax.lax.scan(plane, jnp.zeros_like(matrix.extra[0]), layers)[1]


def _dot(a, b):
    return jnp.sum(a * b, axis=(0, 2), keepdims=True)


def pcg(matrix: Matrix, rhs, iterations: int, line: bool = True):
    """Conjugate gradients, preconditioned along z (`line`) or by the diagonal."""
    if line:
        lines = lines_of(matrix)
        precondition = lambda r: line_solve(lines, r)  # noqa: E731
    else:
        point = diagonal(matrix)[:, None]
        precondition = lambda r: r / point  # noqa: E731

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
    return jax.lax.fori_loop(0, iterations, step, start)[0]


def chebyshev(matrix: Matrix, rhs, iterations: int, radius: float):
    """Chebyshev semi-iteration over lines along z: x <- old + w (line^-1 (rhs + sides x) - old).

    No dot products; one sweep up the planes and one down a round. The coupling in a plane is
    bipartite, so the iteration's spectrum lies in (-r, r), r < 1; `radius` is the guess of r. A low
    guess leaves the smoothest errors, a high one leaves more of all others; none diverges.

    Returns:
      (z, c, n + 2 width), with margins of zeros.
    """
    layers, parts, n = rhs.shape
    width, lines, sides = matrix.width, lines_of(matrix), _sides(matrix)
    zero = jnp.zeros((parts, n), rhs.dtype)

    def round_(x, old, weight):
        def down(value, z):
            total = _row(rhs, z)
            for shift, c in _couplings(matrix, sides, z):
                total = total + c[None] * _at(x, z, shift, width)
            value = total * _row(lines.inverse, z)[None] + _row(lines.low, z)[None] * value
            return value, value

        _, y = jax.lax.scan(down, zero, jnp.arange(layers))

        def up(k, carry):
            value, out = carry
            z = layers - 1 - k
            value = _row(y, z) + _row(lines.high, z)[None] * value
            before = _at(out, z, 0, width)
            new = before + weight * (value - before)
            return value, jax.lax.dynamic_update_slice(out, new[None], (z, 0, width))

        return jax.lax.fori_loop(0, layers, up, (zero, old))[1]

    weights = [1.0, 1.0 / (1.0 - 0.5 * radius**2)]
    while len(weights) < iterations:
        weights.append(1.0 / (1.0 - 0.25 * radius**2 * weights[-1]))
    table = jnp.asarray(weights, rhs.dtype)

    def two(k, carry):
        # Two rounds in turn, so that no array changes places.
        x, old = carry
        old = round_(x, old, table[2 * k])
        return round_(old, x, table[2 * k + 1]), old

    start = jnp.zeros((layers, parts, n + 2 * width), rhs.dtype)
    x, old = jax.lax.fori_loop(0, iterations // 2, two, (start, start))
    return round_(x, old, table[iterations - 1]) if iterations % 2 else x


def fixed_point(matrix: Matrix, rhs, iterations: int):
    """WetBrush's scheme: two Jacobi sweeps on what the pressures so far leave of the right-hand
    side, added up. One Fourier mode with Jacobi eigenvalue l leaves l^K T_K(l) after K rounds."""
    point = diagonal(matrix)[:, None]

    def jacobi(x, r):
        return x + (r - apply(matrix, x)) / point

    def step(_, carry):
        x, r, pressure = carry
        pressure = jacobi(jacobi(pressure, r), r)
        x = x + pressure
        return x, rhs - apply(matrix, x), pressure

    zero = jnp.zeros_like(rhs)
    return jax.lax.fori_loop(0, iterations, step, (zero, rhs, zero))[0]


def residual(matrix: Matrix, x, rhs):
    """(c,) length of rhs - A x over that of rhs."""
    left = rhs - apply(matrix, x)
    size = jnp.maximum(jnp.sqrt(_dot(rhs, rhs)), TINY)
    return (jnp.sqrt(_dot(left, left)) / size)[0, :, 0]


def solve(solver: str, matrix: Matrix, rhs, iterations: int, radius: float = 0.9):
    """Solves A x = rhs, (z, c, n), for each c, by the solver of that name.

    Returns:
      x with margins, (z, c, n + 2 width).
    """
    if solver == "chebyshev":
        return chebyshev(matrix, rhs, iterations, radius)
    if solver == "fixed_point":
        x = fixed_point(matrix, rhs, iterations)
    else:
        x = pcg(matrix, rhs, iterations, line=solver == "zline_pcg")
    return jnp.pad(x, ((0, 0), (0, 0), (matrix.width, matrix.width)))
