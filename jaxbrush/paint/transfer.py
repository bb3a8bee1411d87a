"""Exchange of paint between bristles and canvas.

Deposit and pickup both relax the film towards an equilibrium thickness, set by how high the hair
rides and how thick its coat is. One array of what really moved feeds both sides, so that volume
and every pigment are conserved to rounding.
"""

import jax
import jax.numpy as jnp

from jaxbrush.paint.hair import Hair, corners
from jaxbrush.paint.state import BrushPaint, PaintConfig, PaintParams

TINY = 1e-9
SPAN = 0.25
"""How far to each side hair lies on the highest thread [mm]."""


def _rate(k, travel):
    """Share that a rate k [1/mm] moves over `travel` [mm]."""
    return 1.0 - jnp.exp(-k * travel)


def columns(config: PaintConfig, field, place):
    """Values of (y, x) under points (2, s, b), linear between the middles of columns."""
    h, w = field.shape
    at = [jnp.clip(place[k] / config.pixel - 0.5, 0.0, n - 1.0) for k, n in ((1, h), (0, w))]
    low = [jnp.minimum(jnp.floor(a), n - 2.0) for a, n in zip(at, (h, w), strict=True)]
    y, x = (a - b for a, b in zip(at, low, strict=True))
    j, i = (b.astype(jnp.int32) for b in low)
    flat, first = field.reshape(-1), j * w + i
    upper = (1.0 - x) * flat[first] + x * flat[first + 1]
    lower = (1.0 - x) * flat[first + w] + x * flat[first + w + 1]
    return (1.0 - y) * upper + y * lower


def ride(config: PaintConfig, params: PaintParams, paint, hair: Hair):
    """Heights of the hair (s, b) [mm] after it rode up on thick paint; and the film under it."""
    film = config.layer * jnp.sum(paint, axis=(0, 1))
    under = columns(config, film, hair.place)
    height = jnp.maximum(hair.place[2], 0.0)
    return height + params.compliance * jnp.maximum(under - height, 0.0), under


def threads(config: PaintConfig, tooth):
    """Height of what hair lies on over a weave (y, x) [mm]: the highest within `SPAN`."""
    side = 2 * round(SPAN / config.pixel) + 1
    return jax.lax.reduce_window(
        tooth, jnp.asarray(-jnp.inf, tooth.dtype), jax.lax.max, (side, side), (1, 1), "SAME"
    )


def transfer(config: PaintConfig, params: PaintParams, paint, brush: BrushPaint, hair: Hair, cloth):
    """Moves paint between brush and window in one stamp.

    Hair is too stiff to follow the weave: it lies on the threads, and what hangs from it reaches
    down between them only as far as its coat is thick. So a dry brush paints threads alone.

    Args:
      paint: (z, k, y, x) window. brush: paint of b bristles. hair: points, relative to the window.
      cloth: (2, y, x) height of the canvas's weave and of the `threads` around [mm].

    Returns:
      (paint, brush).
    """
    pigments, bristles = brush.tip.shape
    shape = (paint.shape[0], *paint.shape[2:])
    points = hair.weight.shape[0]
    capacity = params.tip_volume / bristles
    area = params.contact_area / bristles * hair.share
    radius = params.hair_radius
    held = jnp.sum(brush.tip, axis=0)
    load = held / capacity
    coat = radius * (params.coat_dry + params.coat_full * jnp.minimum(load, 1.3))

    z, film = ride(config, params, paint, hair)
    low, high = (columns(config, cloth[k], hair.place) for k in (0, 1))
    z = jnp.maximum(z, high)
    above = z - low
    reach = (radius + coat)[None]
    touch = jnp.clip((reach - (z - high - film)) / reach, 0.0, 1.0) * hair.weight
    touch = touch * (1.0 - jnp.clip((high - low - film) / coat[None], 0.0, 1.0))
    even = jnp.maximum(above + 0.7 * coat[None] - radius, 0.0)
    rising = jnp.maximum(hair.motion[2], 0.0) / hair.travel[None]
    rate = lambda k: _rate(k, hair.travel)[None]  # noqa: E731

    wanted = jnp.clip(even - film, 0.0, 2.0 * coat[None])
    give = rate(params.deposit) * touch * wanted * area
    give = (
        give
        * jnp.clip(2.0 * load, 0.0, 1.0)[None]
        * jnp.clip(1.0 - params.cling * rising, 0.0, 1.0)
    )
    spare = jnp.maximum(held - 0.7 * capacity, 0.0)[None] * hair.share
    give = give + rate(params.squeeze) * touch * spare
    lift = rate(params.pickup) * touch * jnp.clip(film - even, 0.0, 3.0 * radius) * area
    lift = lift * jnp.clip(2.0 - load, 0.0, 1.0)[None]
    swap = rate(params.exchange) * touch * jnp.minimum(film, params.exchange_depth) * area

    # Where: the cells around the point, not above the film's surface.
    at = jnp.minimum(z, film) - 0.5 * config.layer
    place = jnp.stack(
        [
            hair.place[0] / config.pixel - 0.5,
            hair.place[1] / config.pixel - 0.5,
            jnp.maximum(at, 0.0) / config.layer - 0.5,
        ]
    ).reshape(3, -1)
    index, share = corners(config, place, shape)
    fill = jnp.sum(paint, axis=1).reshape(-1)
    asked = (lift + swap).reshape(-1)[None] * share / config.cell
    total = jnp.zeros_like(fill).at[index].add(asked)
    granted = jnp.minimum(1.0, 0.9 * fill / jnp.maximum(total, TINY))
    taken = asked * granted[index]
    lost = total * granted / jnp.maximum(fill, TINY)
    by = taken / jnp.maximum(fill, TINY)[index]
    plane = shape[1] * shape[2]
    level, column = jax.lax.div(index, plane), jax.lax.rem(index, plane)
    # (k, 8, n): the same cells of each pigment, which lie a plane apart.
    pigment = jnp.arange(pigments, dtype=jnp.int32)[:, None, None]
    cells = (level[None] * pigments + pigment) * plane + column[None]
    gained = jnp.sum(by[None] * paint.reshape(-1)[cells], axis=1) * config.cell
    gained = jnp.sum(gained.reshape(pigments, points, bristles), axis=1)
    amount = jnp.sum(taken, axis=0).reshape(points, bristles) * config.cell
    back = amount * swap / jnp.maximum(lift + swap, TINY * config.cell)

    # What a bristle gives is at most half of what it holds.
    out = give + back
    most = 0.5 * held / jnp.maximum(jnp.sum(out, axis=0), TINY * config.cell)
    inside = jnp.sum(share, axis=0).reshape(points, bristles)
    out = out * jnp.minimum(1.0, most)[None] * jnp.where(inside > 0.0, 1.0, 0.0)
    mix = brush.tip / jnp.maximum(held, TINY * config.cell)[None]
    added = (out / jnp.maximum(inside, TINY)).reshape(-1)[None] * share / config.cell
    given = mix[:, None] * out[None]
    tip = brush.tip - jnp.sum(given, axis=1) + gained
    by_point = jnp.broadcast_to(mix[:, None], (pigments, points, bristles)).reshape(pigments, 1, -1)
    paint = paint * (1.0 - lost).reshape(shape)[:, None]
    paint = paint.reshape(-1).at[cells].add(by_point * added[None]).reshape(paint.shape)
    return paint, BrushPaint(tip=tip, reservoir=brush.reservoir)


def refill(config: PaintConfig, params: PaintParams, brush: BrushPaint, travel) -> BrushPaint:
    """Flow between the tips and the reservoir behind them; a tip over 1.8 times full gives back."""
    bristles = brush.tip.shape[1]
    capacity, most = params.tip_volume / bristles, params.reservoir_volume / bristles
    held, behind = jnp.sum(brush.tip, axis=0), jnp.sum(brush.reservoir, axis=0)
    down = _rate(params.refill, travel) * jnp.maximum(capacity - held, 0.0)
    down = jnp.minimum(down * jnp.clip(behind / (0.3 * most), 0.0, 1.0), 0.9 * behind)
    up = 0.5 * jnp.maximum(held - 1.8 * capacity, 0.0)
    falling = (down / jnp.maximum(behind, TINY * config.cell))[None] * brush.reservoir
    rising = (up / jnp.maximum(held, TINY * config.cell))[None] * brush.tip
    return BrushPaint(
        tip=brush.tip + falling - rising, reservoir=brush.reservoir - falling + rising
    )
