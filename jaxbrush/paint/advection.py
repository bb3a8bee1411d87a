"""Conservative motion of pigment amounts: limited fluxes, columns repacked, steep steps slumped."""

import jax
import jax.numpy as jnp

from jaxbrush.paint.solvers import _last, _next
from jaxbrush.paint.state import PaintConfig, PaintParams
from jaxbrush.paint.velocity import AXES

TINY = 1e-9
SLOP = 1e-5
"""Excess or lack of a cell that is left alone, share of a cell."""


def _limited(fill, q, n):
    """Van Leer value of `fill` on the faces along axis n, for displacement q [cells]."""
    forward = _next(fill, n) - fill
    backward = fill - _last(fill, n)
    smooth = forward * backward > 0.0
    # Ends in a division, which XLA stores instead of working it out again for each reader.
    slope = jnp.where(smooth, 2.0 * forward * backward, 0.0)
    slope = slope / jnp.where(smooth, forward + backward, 1.0)
    left = fill + 0.5 * (1.0 - q) * slope
    right = _next(fill - 0.5 * (1.0 + q) * slope, n)
    return jnp.where(q > 0.0, left, right)


def advect(config: PaintConfig, paint, face):
    """Moves pigments (z, k, y, x) by face displacements [cells], all below one cell.

    One scalar flux of paint a face carries the pigments in the shares of the cell it leaves, and
    no cell gives more than it has: amounts stay positive, colors in the hull of what was there.
    """
    fill = jnp.sum(paint, axis=1)
    right, left, out = [], [], 0.0
    for k, axis in enumerate(AXES):
        n = 3 + axis
        q = jnp.clip(face[k], -1.0, 1.0)
        if config.limiter and k < 2:
            value = _limited(fill, q, n)
        else:
            value = jnp.where(q > 0.0, fill, _next(fill, n))
        flux = q * value
        right.append(jnp.maximum(flux, 0.0))
        left.append(_last(jnp.maximum(-flux, 0.0), n))
        out = out + right[k] + left[k]
    # Shares of a cell that leave it, together less than 1 by more than rounding.
    limit = jnp.maximum(1.000001 * out, jnp.maximum(fill, TINY))
    moved, stays = 0.0, 1.0
    for k, axis in enumerate(AXES):
        m = 4 + axis if k < 2 else 0
        for leaving, arrive in ((right[k], _last), (left[k], _next)):
            share = leaving / limit
            stays = stays - share
            moved = moved + arrive(paint * share[:, None], m)
    return paint * stays[:, None] + moved


def repack(paint, capacity):
    """Columns without overfull cells and without holes, order kept; the top cell keeps any rest.

    Args:
      paint: (z, k, y, x). capacity: (z, y, x) share of each cell that paint may fill.
    """
    layers = paint

    def push(carry, inputs):
        cell, room = inputs
        cell = cell + carry
        total = jnp.sum(cell, axis=0)
        # Within rounding of full is full: paint at rest must not creep by single bits.
        keep = jnp.where(total > SLOP + room, room / jnp.maximum(total, TINY), 1.0)
        stay = cell * keep[None]
        return cell - stay, stay

    rest, layers = jax.lax.scan(push, jnp.zeros_like(layers[0]), (layers, capacity))
    layers = jnp.concatenate([layers[:-1], layers[-1:] + rest[None]])

    def pull(cell, inputs):
        upper, room = inputs
        total = jnp.sum(cell, axis=0)
        lack = jnp.where(room - total > SLOP, room - total, 0.0)
        have = jnp.sum(upper, axis=0)
        share = jnp.minimum(1.0, lack / jnp.maximum(have, TINY))
        down = upper * share[None]
        return upper - down, cell + down

    top, lower = jax.lax.scan(pull, layers[0], (layers[1:], capacity[:-1]))
    return jnp.concatenate([lower, top[None]])


def slump(config: PaintConfig, params: PaintParams, paint, near, step):
    """Lets steep steps of the surface fall towards lower neighbours near the hair.

    Args:
      near: (y, x) 1 where hair is close. step: () travel of the brush [mm].
    """
    fill = jnp.sum(paint, axis=1)
    height = jnp.sum(fill, axis=0)
    rate = 0.25 * (1.0 - jnp.exp(-4.0 * params.relax * step))
    stands = params.relax_slope / config.layer
    # The paint that can move: the topmost cells of a column, 1.5 deep.
    above = jnp.flip(jnp.cumsum(jnp.flip(fill, 0), axis=0), 0) - fill
    loose = jnp.clip(1.5 - above, 0.0, fill)
    loose = paint * (loose / jnp.maximum(fill, TINY))[:, None]
    amount = jnp.maximum(jnp.sum(loose, axis=(0, 1)), TINY)
    h, w = height.shape
    edge_y = (jnp.arange(h) < h - 1).astype(paint.dtype)[:, None]
    edge_x = (jnp.arange(w) < w - 1).astype(paint.dtype)[None]
    out, moves = 0.0, []
    for n, edge in ((0, edge_y), (1, edge_x)):
        drop = height - _next(height, n)
        size = jnp.maximum(jnp.abs(drop) - stands, 0.0) * jnp.sign(drop)
        flux = rate * size * edge * jnp.maximum(near, _next(near, n))
        moves.append(flux)
        out = out + jnp.maximum(flux, 0.0) + _last(jnp.maximum(-flux, 0.0), n)
    scale = jnp.minimum(1.0, 0.9 * amount / jnp.maximum(out, TINY)) / amount
    layers = paint.shape[0]
    top = jnp.clip(jnp.floor(height), 0.0, layers - 1.0)
    level = jnp.arange(layers, dtype=paint.dtype)[:, None, None]
    landing = (level == top[None]).astype(paint.dtype)
    column = jnp.sum(loose, axis=0)
    gained, lost = 0.0, 0.0
    for n, flux in enumerate(moves):
        forward = jnp.maximum(flux, 0.0) * scale
        back = jnp.maximum(-flux, 0.0)
        here = back * _next(scale, n)
        lost = lost + forward + _last(here, n)
        arrives = _last(forward[None] * column, n + 1) + here[None] * _next(column, n + 1)
        gained = gained + arrives
    return paint - loose * lost[None, None] + gained[None] * landing[:, None]
