"""What each bristle has picked up on its way: a sum along it, without a grid of paint.

The maps of the paper hold the color that a brush sets out with, and a network sees 39 pixels: a
color that a bristle takes along for farther cannot reach its output. Here every bristle carries a
running mean of the canvas under it as it was before the stroke, which fades with the way.
"""

import jax
import jax.numpy as jnp

from jaxbrush.brush import BristleTrack
from jaxbrush.canvas import Canvas, absorbed, reflected

FADES = 5.0
"""[mm] of a bristle's way on which what it picked up falls to 1/e: what its tip holds over what it
lays."""
THICK = 0.1
"""Film [mm] of which a bristle takes as much as it can."""
LEAST = 1e-3
"""Share below which what is carried has no color of its own."""


def picked_up(track: BristleTrack, canvas: Canvas, pixel: float, coat: float):
    """Color that bristles carry besides their own, and how much of it.

    Colors mix as paint does (`canvas.absorbed`). Differentiable in the canvas; the pixel that a
    bristle stands on has no slope.

    Args:
      track: of t stamps, b bristles, on the canvas. canvas: (h, w), before the stroke. pixel: [mm].
      coat: above the canvas or its paint at which a bristle touches [mm].

    Returns:
      (color (t, b, 3) linear RGB, 0 where nothing was picked up; share (t, b) in [0, 1], 1 after a
      long way through thick paint).
    """
    tip = track.position[:, -1]
    h, w = canvas.height.shape
    at = jnp.floor(tip[:, 1::-1] / pixel)
    there = jnp.all((at >= 0.0) & (at < jnp.asarray([h, w], at.dtype)[None, :, None]), axis=1)
    # Clipped here: XLA's own clamping is wrong in some releases.
    row = jnp.clip(at[:, 0], 0.0, h - 1.0).astype(jnp.int32)
    column = jnp.clip(at[:, 1], 0.0, w - 1.0).astype(jnp.int32)
    film = canvas.height[row, column]
    touch = there & track.valid[:, None] & (tip[:, 2] < film + coat)
    wet = jnp.where(touch, jnp.clip(film / THICK, 0.0, 1.0), 0.0)
    under = wet[..., None] * absorbed(canvas.color[row, column])
    way = jnp.diff(tip[:, :2], axis=0, prepend=tip[:1, :2])
    keep = jnp.exp(-jnp.sqrt(jnp.sum(way * way, axis=1) + 1e-12) / FADES)
    # (t, 4, b): of each bristle, what it carries of three channels and in all.
    new = jnp.concatenate([jnp.moveaxis(under, -1, 1), wet[:, None]], axis=1)
    new = (1.0 - keep[:, None]) * new

    def step(carried, inputs):
        keep, new = inputs
        carried = keep[None] * carried + new
        return carried, carried

    _, carried = jax.lax.scan(step, jnp.zeros_like(new[0]), (keep, new))
    share = carried[:, 3]
    some = share > LEAST
    mean = jnp.moveaxis(carried[:, :3], 1, -1) / jnp.where(some, share, 1.0)[..., None]
    return jnp.where(some[..., None], reflected(mean), 0.0), jnp.where(some, share, 0.0)
