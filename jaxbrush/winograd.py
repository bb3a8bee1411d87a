"""Convolutions of stride 1 with fewer products (Winograd 1980; Lavin and Gray 2016).

Two by two output pixels of a kernel of side k take (k + 1)^2 products per pair of channels in place
of 4 k^2: 2.25 times fewer for k = 3, 2.56 for k = 4. What pixels and kernels are turned into are
sums with small factors: results and slopes are the plain convolution's to 1e-6 to 3e-6 of their
spread in float32. A pixel's rounding depends on its place in a tile, so patches of a picture do not
come out as the whole does to the last bit.
"""

import functools

import jax.numpy as jnp
import numpy as np
from jax import lax

TILE = 2
POINTS = (0.0, 1.0, -1.0, 2.0)
"""Where polynomials are evaluated, beside infinity, which comes last."""


@functools.cache
def transforms(side: int):
    """Toom and Cook's matrices for kernels of `side`: y = collect^T [(kernel g) * (picture d)].

    Returns:
      (collect (side + 1, 2), kernel (side + 1, side), picture (side + 1, side + 1)), float32.

    Raises:
      ValueError: a side other than 3 or 4.
    """
    if side not in (3, 4):
        raise ValueError(f"side = {side}: expected 3 or 4")

    def powers(count):
        finite = [[p**j for j in range(count)] for p in POINTS[:side]]
        return np.array([*finite, [0.0] * (count - 1) + [1.0]])

    # The transpose of: two polynomials, multiplied point by point, back to coefficients.
    picture = np.linalg.inv(powers(side + 1)).T
    size = np.array([np.abs(row[np.abs(row) > 1e-9]).min() for row in picture])
    picture = np.round(picture / size[:, None], 9)
    return tuple(
        m.astype(np.float32) for m in (powers(TILE), powers(side) * size[:, None], picture)
    )


def _sum(factors, terms):
    """Of terms by factors known now; those of 0 are left out."""
    total = None
    for factor, term in zip(factors, terms, strict=True):
        if factor != 0.0:
            term = term if factor == 1.0 else float(factor) * term
            total = term if total is None else total + term
    return total


def _both(matrix, terms):
    """matrix [terms] matrix^T for terms[i][j], pictures."""
    rows = [[_sum(row, column) for column in zip(*terms, strict=True)] for row in matrix]
    return [[_sum(row, one) for row in matrix] for one in rows]


def _every(x, begin, count):
    """x (n, h, w, c) at every second row and column from `begin`: (n, *count, c)."""
    (y, x0), (rows, columns) = begin, count
    return x[:, y : y + TILE * (rows - 1) + 1 : TILE, x0 : x0 + TILE * (columns - 1) + 1 : TILE]


def pad(x, before: int, after: int):
    """x (n, h, w, c) with zeros around, as many on both axes."""
    return jnp.pad(x, ((0, 0), (before, after), (before, after), (0, 0)))


def _tiles(shape, side):
    return -(-(shape[1] - side + 1) // TILE), -(-(shape[2] - side + 1) // TILE)


def _pictures(x, side):
    """[i][j] to (n tiles, c): the tiles of x, turned."""
    count = _tiles(x.shape, side)
    missing = [TILE * t + side - 1 - s for t, s in zip(count, x.shape[1:3], strict=True)]
    x = jnp.pad(x, ((0, 0), (0, missing[0]), (0, missing[1]), (0, 0)))
    taps = range(side + 1)
    turned = _both(transforms(side)[2], [[_every(x, (a, b), count) for b in taps] for a in taps])
    return [[one.reshape(-1, x.shape[3]) for one in row] for row in turned]


def _turned(kernel):
    """(side + 1, side + 1, i, o)."""
    side, _, ins, outs = kernel.shape
    both = jnp.asarray(np.kron(transforms(side)[1], transforms(side)[1]), kernel.dtype)
    turned = jnp.matmul(both, kernel.reshape(side * side, -1), precision=lax.Precision.HIGHEST)
    return turned.reshape(side + 1, side + 1, ins, outs)


def _kernel_slope(x, slope, side):
    rows, columns = _tiles(x.shape, side)
    missing = TILE * rows - slope.shape[1], TILE * columns - slope.shape[2]
    slope = jnp.pad(slope, ((0, 0), (0, missing[0]), (0, missing[1]), (0, 0)))
    parts = [[_every(slope, (p, q), (rows, columns)) for q in range(TILE)] for p in range(TILE)]
    spread = _both(transforms(side)[0], parts)
    ins, outs = x.shape[3], slope.shape[3]
    products = [
        jnp.matmul(one.T, other.reshape(-1, outs))
        for row, others in zip(_pictures(x, side), spread, strict=True)
        for one, other in zip(row, others, strict=True)
    ]
    both = jnp.asarray(np.kron(transforms(side)[1], transforms(side)[1]).T, x.dtype)
    products = jnp.stack(products).reshape((side + 1) ** 2, -1)
    slope = jnp.matmul(both, products, precision=lax.Precision.HIGHEST)
    return slope.reshape(side, side, ins, outs)


def convolve(x, kernel):
    """Convolution without padding.

    Args:
      x: (n, h, w, i), of sides not below the kernel's. kernel: (k, k, i, o), k of 3 or 4.

    Returns:
      (n, h - k + 1, w - k + 1, o).
    """
    n, side, outs = x.shape[0], kernel.shape[0], kernel.shape[3]
    rows, columns = _tiles(x.shape, side)
    turned = _turned(kernel)
    products = [
        [jnp.matmul(one, turned[i, j]) for j, one in enumerate(row)]
        for i, row in enumerate(_pictures(x, side))
    ]
    y = _both(transforms(side)[0].T, products)
    y = [[one.reshape(n, rows, columns, outs) for one in row] for row in y]
    y = jnp.stack([jnp.stack(row, 3) for row in y], 2).reshape(n, TILE * rows, TILE * columns, outs)
    return y[:, : x.shape[1] - side + 1, : x.shape[2] - side + 1]


def slopes(x, kernel, slope, padding):
    """Those of `convolve` of a padded picture, at the picture without it and at the kernel.

    Args:
      x: (n, h, w, i), not padded. kernel: (k, k, i, o). slope: at the result.
      padding: zeros (before, after) along both axes, each below k.

    Returns:
      Shaped as x and as kernel.
    """
    edge = kernel.shape[0] - 1
    before, after = padding
    around = pad(slope, edge - before, edge - after)
    to_x = convolve(around, kernel[::-1, ::-1].swapaxes(2, 3))
    return to_x, _kernel_slope(pad(x, before, after), slope, kernel.shape[0])
