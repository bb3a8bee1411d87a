"""Conservative motion of pigment amounts: limited fluxes, columns repacked, steep steps slumped.

Paint is flat planes (z, k, n), n = y * x.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.paint.state import PaintConfig, PaintParams, relaxation
from jaxbrush.paint.stencil import inner_x, inner_y, near, wide

TINY = 1e-9
LOOSE = 0.09375
"""Depth of the paint that slumps from a column at once, at most [mm]."""
SLOP = 1e-5
"""Excess or lack of a cell that is left alone, share of a cell."""


def _slopes(fill, margin, shift, open_):
    """Slopes of wide fill along one axis, (z, n): van Leer's, and what that lacks of fourth order.

    open_: (1, n) 0 in the two cells next to a side of the window, where nothing lacks.
    """
    here = near(fill, margin)
    forward = near(fill, margin, shift) - here
    backward = here - near(fill, margin, -shift)
    smooth = forward * backward > 0.0
    limited = jnp.where(smooth, 2.0 * forward * backward, 0.0)
    limited = limited / jnp.where(smooth, forward + backward, 1.0)
    far = near(fill, margin, 2 * shift) - near(fill, margin, -2 * shift)
    return limited, open_ * ((2.0 / 3.0) * (forward + backward) - far / 12.0 - limited)


def _upwind(fill, width, face):
    """Fill as it sets out for the faces along x and along y, and its slopes.

    A limiter takes grooves for noise: they are 3 or 4 cells wide, and every cell is a crest or a
    trough. Along the flow that does no harm to them. Across it, it smooths what no flow along an
    axis would smooth: strokes at 45 degrees lost 29 % of their contrast. So slopes are limited
    only along the flow. And paint that passes a face obliquely comes from half a stamp upstream in
    the other direction too (corner transport), or it would be smoothed across the flow.

    Args:
      fill: wide with margins of two rows. face: wide displacements along x and y.

    Returns:
      (two wide fields to start from, two wide slopes) [share of a cell].
    """
    margin, shifts = 2 * width, (1, width)
    here = near(fill, margin)
    middle = [
        0.5 * (near(f, width) + near(f, width, -s)) for f, s in zip(face, shifts, strict=True)
    ]
    open_ = np.pad(np.ones((width - 4, width - 4)), 2).reshape(1, -1)
    pairs = [_slopes(fill, margin, shift, jnp.asarray(open_, here.dtype)) for shift in shifts]
    limited, lack = zip(*pairs, strict=True)
    # The part of what the limiter took away that points across the flow.
    across = middle[1] * lack[0] - middle[0] * lack[1]
    across = across / (middle[0] * middle[0] + middle[1] * middle[1] + 1e-9)
    slopes = (limited[0] + middle[1] * across, limited[1] - middle[0] * across)
    starts = []
    for f, shift in ((face[1], width), (face[0], 1)):
        change = jnp.clip(near(f, width), -1.0, 0.0) * (near(fill, margin, shift) - here)
        change = change + jnp.clip(near(f, width, -shift), 0.0, 1.0) * (
            here - near(fill, margin, -shift)
        )
        starts.append(wide(here - 0.5 * change, width))
    return starts, [wide(s, width) for s in slopes]


def advect(config: PaintConfig, paint, face, bound=0.0):
    """Moves pigments (z, k, n) by wide face displacements [cells], all below one cell; but for a
    film of `bound` [mm] on the canvas, which a cell's speed is far too fast for: it sticks.

    One scalar flux of paint a face carries the pigments in the shares of the cell it leaves, and
    no cell gives more than it has: amounts stay positive, colors in the hull of what was there.
    """
    width = config.window
    # A row more in the margins than `near` elsewhere reads.
    fill = wide(jnp.sum(paint, axis=1), 2 * width)
    here = near(fill, 2 * width)
    loose = 1.0 - bound / config.layer / jnp.maximum(here[:1], TINY)
    loose = jnp.maximum(jnp.pad(loose, ((0, here.shape[0] - 1), (0, 0)), constant_values=1.0), 0.0)
    free = wide(loose, width)
    steps = ((1, 0), (width, 0), (0, 1))
    if config.limiter:
        starts, slopes = _upwind(fill, width, face[:2])
    fluxes, out = [], 0.0
    for k, (shift, layer) in enumerate(steps):
        q = jnp.clip(near(face[k], width), -1.0, 1.0)
        if config.limiter and not layer:
            left = near(starts[k], width) + 0.5 * (1.0 - q) * near(slopes[k], width)
            right = near(starts[k], width, shift)
            right = right - 0.5 * (1.0 + q) * near(slopes[k], width, shift)
            left, right = jnp.maximum(left, 0.0), jnp.maximum(right, 0.0)
        else:
            left, right = here, near(fill, 2 * width, shift, layer)
        left, right = left * loose, right * near(free, width, shift, layer)
        fluxes.append(wide(q * jnp.where(q > 0.0, left, right), width))
    for (shift, layer), flux in zip(steps, fluxes, strict=True):
        out = out + jnp.maximum(near(flux, width), 0.0)
        out = out + jnp.maximum(-near(flux, width, -shift, -layer), 0.0)
    # Shares of a cell that leave it, together less than 1 by more than rounding.
    by = wide(1.0 / jnp.maximum(1.000001 * out, jnp.maximum(here, TINY)), width)
    stays, moved = 1.0, 0.0
    paint = wide(paint, width)
    for (shift, layer), flux in zip(steps, fluxes, strict=True):
        # Share of the cell it leaves, with the sign of the flux.
        go = near(flux, width)
        go = go * jnp.where(go > 0.0, near(by, width), near(by, width, shift, layer))
        go = wide(go, width)
        ahead, behind = near(go, width), near(go, width, -shift, -layer)
        stays = stays - jnp.maximum(ahead, 0.0) - jnp.maximum(-behind, 0.0)
        moved = moved + jnp.maximum(behind, 0.0)[:, None] * near(paint, width, -shift, -layer)
        moved = moved + jnp.maximum(-ahead, 0.0)[:, None] * near(paint, width, shift, layer)
    return near(paint, width) * stays[:, None] + moved


def repack(paint, capacity):
    """Columns without overfull cells and without holes, order kept; the top cell keeps any rest.

    Args:
      paint: (z, k, n). capacity: (z, n) share of each cell that paint may fill.
    """

    def push(carry, inputs):
        cell, room = inputs
        cell = cell + carry
        total = jnp.sum(cell, axis=0)
        # Within rounding of full is full: paint at rest must not creep by single bits.
        keep = jnp.where(total > SLOP + room, room / jnp.maximum(total, TINY), 1.0)
        stay = cell * keep[None]
        return cell - stay, stay

    rest, layers = jax.lax.scan(push, jnp.zeros_like(paint[0]), (paint, capacity))
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


def slump(config: PaintConfig, params: PaintParams, paint, hairy, step):
    """Lets steep steps of the surface fall towards lower neighbours near the hair.

    Args:
      paint: (z, k, n). hairy: (n,) 1 where hair is close. step: () travel of the brush [mm].
    """
    width, one = config.window, 1.0 + 0.0 * step
    flat = lambda columns: wide(columns[None], width)  # noqa: E731
    at = lambda planes, shift=0: near(planes, width, shift)[0]  # noqa: E731

    def down(carry, cell):
        # The paint that can move: the uppermost of a column.
        above, column = carry
        fill = jnp.sum(cell, axis=0)
        loose = jnp.clip(LOOSE / config.layer - above, 0.0, fill) / jnp.maximum(fill, TINY)
        return (above + fill, column + cell * loose[None]), loose

    start = (jnp.zeros_like(paint[0, 0]), jnp.zeros_like(paint[0]))
    (height, column), loose = jax.lax.scan(down, start, paint, reverse=True)
    rate, stands = relaxation(config, params, step)
    stands = stands / config.layer
    high, close = flat(height), flat(hairy)
    fluxes, out = [], 0.0
    for shift, inner in ((1, inner_x(width, width)), (width, inner_y(width, width))):
        drop = height - at(high, shift)
        size = jnp.maximum(jnp.abs(drop) - stands, 0.0) * jnp.sign(drop)
        flux = rate * size * jnp.asarray(inner, paint.dtype) * jnp.maximum(hairy, at(close, shift))
        fluxes.append(flat(flux))
        out = out + jnp.maximum(flux, 0.0) + jnp.maximum(-at(fluxes[-1], -shift), 0.0)
    amount = jnp.maximum(jnp.sum(column, axis=0), TINY)
    # Of what is loose, the share that moves for each unit of flux.
    scale = jnp.minimum(1.0, 0.9 * amount / jnp.maximum(out, TINY)) / amount
    by, column = flat(scale), wide(column[None], width)
    gained, lost = 0.0, 0.0
    for shift, flux in zip((1, width), fluxes, strict=True):
        ahead, behind = at(flux), at(flux, -shift)
        lost = lost + (jnp.maximum(ahead, 0.0) + jnp.maximum(-behind, 0.0)) * scale
        gained = gained + (jnp.maximum(behind, 0.0) * at(by, -shift))[None] * at(column, -shift)
        gained = gained + (jnp.maximum(-ahead, 0.0) * at(by, shift))[None] * at(column, shift)
    lost, gained = lost / one, gained / one
    # It lands on the surface: what the topmost cell has room for, and the rest above.
    level = jnp.arange(paint.shape[0], dtype=paint.dtype)[:, None]
    amount = jnp.sum(gained, axis=0)
    raised = jnp.clip((height + amount)[None] - level, 0.0, 1.0)
    raised = raised.at[-1].add(jnp.maximum(height + amount - paint.shape[0], 0.0))
    full = jnp.clip(height[None] - level, 0.0, 1.0)
    full = full.at[-1].add(jnp.maximum(height - paint.shape[0], 0.0))
    landing = (raised - full) / jnp.maximum(amount, TINY)[None]
    return paint * (1.0 - loose * lost[None])[:, None] + gained[None] * landing[:, None]
