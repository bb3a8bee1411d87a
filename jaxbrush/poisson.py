"""Poisson blend of overlapping patches (Pérez et al. 2003; paper 4.3, Figure 9), solved directly.

A tile has three overlaps: a strip that two patches share along y, one along x, and the square
between them that four share. Beside the overlaps the picture is that of the one patch there. Inside
it has, as nearly as possible, gradients G that fade linearly from those of one patch to those of
the next (Levin et al. 2004): with F the linear fade of the patches themselves the picture is F + c,

  laplace(c) = div(G - grad F),  c = 0 around each of the three.

So strips end, and squares begin, at a line where patches fade linearly: the blend of a tile depends
on its four patches alone. Where the patches beyond a side of a square are not painted, that side is
free (no flux) instead.

A rectangle is solved by the eigenvectors of second differences along its two axes (sines where
both ends are held, cosines where both are free), as matrix products.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.patches import Layout, PatchConfig, parts_of, shares_of, weighted


@functools.lru_cache
def _basis(size: int, low: bool, high: bool):
    """Eigenvectors (size, size) in columns and eigenvalues (size,) of second differences, the ends
    free or held at 0."""
    matrix = np.diag(np.full(size, -2.0)) + np.eye(size, k=1) + np.eye(size, k=-1)
    matrix[0, 0] += low
    matrix[-1, -1] += high
    values, vectors = np.linalg.eigh(matrix)
    if low and high:
        values[np.argmax(values)] = 0.0
    return vectors, values


def _bases(size: int, dtype):
    """Of the four kinds of ends, (4, size, size) and (4, size), by 2 * low + high."""
    kinds = [_basis(size, low, high) for low in (False, True) for high in (False, True)]
    return tuple(jnp.asarray(np.stack(parts), dtype) for parts in zip(*kinds, strict=True))


def solve(source, free=None):
    """Solves laplace(c) = source on rectangles, by the five-point stencil.

    Args:
      source: (n, h, w, c). free: (n, 4) bool, whether nothing flows through the top, bottom, left
        and right, or None; c is 0 one pixel beyond the other sides.

    Returns:
      (n, h, w, c). With four free sides the mean of the source is ignored and that of c is 0.
    """
    n, h, w, _ = source.shape
    (rows, down), (columns, right) = _bases(h, source.dtype), _bases(w, source.dtype)
    precision = jax.lax.Precision.HIGHEST
    if free is None:
        kinds = (0, 0)
        forward, back = "ji,njkc,kl->nilc", "ij,njkc,lk->nilc"
        down, right = down[0][None], right[0][None]
    else:
        number = free.astype(jnp.int32)
        kinds = tuple(2 * number[:, k] + number[:, k + 1] for k in (0, 2))
        forward, back = "nji,njkc,nkl->nilc", "nij,njkc,nlk->nilc"
        down, right = down[kinds[0]], right[kinds[1]]
    rows, columns = rows[kinds[0]], columns[kinds[1]]
    spectrum = jnp.einsum(forward, rows, source, columns, precision=precision)
    values = (down[:, :, None] + right[:, None, :])[..., None]
    flat = values > -1e-7
    spectrum = jnp.where(flat, 0.0, spectrum / jnp.where(flat, 1.0, values))
    return jnp.einsum(back, rows, spectrum, columns, precision=precision)


def _lack(parts, shares, faded, axis: int):
    """Gradient of the parts, faded from one to the next, less the gradient of their fade; from
    pixel to pixel along an axis."""
    ahead = lambda x: jax.lax.slice_in_dim(x, 1, None, axis=axis)  # noqa: E731
    behind = lambda x: jax.lax.slice_in_dim(x, 0, -1, axis=axis)  # noqa: E731
    total, weight = 0.0, 0.0
    for (value, there), share in zip(parts, shares, strict=True):
        w = ahead(there) * behind(there) * (ahead(share) + behind(share))
        total, weight = total + w * (ahead(value) - behind(value)), weight + w
    mean = total / jnp.where(weight > 0.0, weight, 1.0)
    return jnp.where(weight > 0.0, mean - (ahead(faded) - behind(faded)), 0.0)


def merge(options: PatchConfig, patches, layout: Layout):
    """The tiles that patches make together, blended in their overlaps.

    Exact where patches differ by a constant, which then falls linearly over the overlap; patches
    that agree there are unchanged.

    Args:
      patches: (n, size, size, c).

    Returns:
      (m, step, step, c).
    """
    parts = parts_of(options, patches, layout)
    shares = shares_of(options, sharp=False, dtype=patches.dtype)
    faded = weighted(parts, shares)
    down, right = _lack(parts, shares, faded, 1), _lack(parts, shares, faded, 2)
    step = options.step
    alone = step - options.overlap
    there = layout.parts < patches.shape[0]
    gone = [~(there[:, a] | there[:, b]) for a, b in ((0, 1), (2, 3), (0, 2), (1, 3))]
    free = jnp.stack(gone, axis=1)

    def inside(top, bottom, left, end, free=None):
        """c in the rectangle of these pixels."""
        # From the pixel before the first to that behind the last. Through a free side there is no
        # flux already: no patch has pixels on both sides of it.
        source = jnp.diff(down[:, top - 1 : bottom, left:end], axis=1)
        source = source + jnp.diff(right[:, top:bottom, left - 1 : end], axis=2)
        around = ((0, 0), (top, step - bottom), (left, step - end), (0, 0))
        return jnp.pad(solve(source, free), around)

    strips = inside(1, alone - 1, alone, step) + inside(alone, step, 1, alone - 1)
    return faded[:, :-1, :-1] + strips + inside(alone, step, alone, step, free)
