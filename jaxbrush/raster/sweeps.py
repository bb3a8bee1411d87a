"""The sweep of a bristle between two stamps: a capsule, and what it says about a pixel.

Everything is in pixels: the centres of a grid's pixels lie at whole numbers.
"""

import dataclasses

import jax
import jax.numpy as jnp

from jaxbrush.structs import state

TIP_STIFFNESS = 37.0
"""[µN/mm] of a default hog bristle's tip, 3 EI / L^3: turns a force into a depth pressed."""
POINT = 0.02
"""Sweeps much shorter than this [pixels] count as points."""
FAR = 1e6
"""Where sweeps that touch nothing are put [pixels], and more than any measure of one that does."""


@state
class Sweeps:
    """One sweep for each stamp and bristle, every field (t, b), or rows of it.

    x, y: where it starts; ex, ey: from start to end; ax, ay: the same over its square length
    [pixels]. low, high: the share of it on which the bristle touches. press, gain: force at the
    start and its change [µN]. time, span: at the start and its change, shares of the stroke.
    depth: how far the tip is pressed below first touch, at most [mm]; negative in the air.
    """

    x: jax.Array
    y: jax.Array
    ex: jax.Array
    ey: jax.Array
    ax: jax.Array
    ay: jax.Array
    low: jax.Array
    high: jax.Array
    press: jax.Array
    gain: jax.Array
    time: jax.Array
    span: jax.Array
    depth: jax.Array


def _start(x):
    """Values at the stamp before; the first stamp has its own."""
    return jnp.concatenate([x[:1], x[:-1]])


def stroke_time(track):
    """(t,) from 0 at the first stamp to 1 at the last valid one; 0 if that takes no time."""
    begin = track.time[0]
    duration = jnp.max(jnp.where(track.valid, track.time, begin)) - begin
    share = (track.time - begin) / jnp.where(duration > 0.0, duration, 1.0)
    return jnp.clip(jnp.where(duration > 0.0, share, 0.0), 0.0, 1.0)


def sweeps_of(grid, track, nodes: int, threshold: float) -> Sweeps:
    """All sweeps of a track, from the stamp before to each stamp; the first one is a point.

    Args:
      grid: where the pixels are.
      track: BristleTrack of t stamps.
      nodes: how many nodes of a bristle, from the tip up, draw; each counts as a bristle.
      threshold: depth at which a bristle begins to touch [mm].
    """
    have = track.position.shape[1]
    if not 1 <= nodes <= have:
        raise ValueError(f"nodes = {nodes}: expected between 1 and the {have} of the track")
    stamps = track.position.shape[0]
    flat = lambda x: x[:, -nodes:].reshape(stamps, -1)  # noqa: E731
    origin = grid.origin.astype(track.position.dtype)
    x = (flat(track.position[:, :, 0]) - origin[0]) / grid.pixel - 0.5
    y = (flat(track.position[:, :, 1]) - origin[1]) / grid.pixel - 0.5
    z, force = flat(track.position[:, :, 2]), flat(track.force)
    # Padding, and what is not finite or past all canvases, is far above this one.
    known = (jnp.abs(x) < FAR) & (jnp.abs(y) < FAR) & (jnp.abs(z) < FAR) & (jnp.abs(force) < FAR)
    known &= track.valid[:, None]
    x, y, z, force = (jnp.where(known, v, 0.0) for v in (x, y, z, force))
    force = jnp.where(force > 0.0, force, 0.0)
    above = jnp.where(known, jnp.maximum(jnp.abs(z), 1e-6), FAR)
    end = jnp.where(force > 0.0, force / TIP_STIFFNESS, -above)
    time = jnp.broadcast_to(stroke_time(track)[:, None].astype(x.dtype), x.shape)

    start = _start(end)
    sink = end - start
    steep = jnp.where(jnp.abs(sink) > 1e-9, sink, 1.0)
    crossing = jnp.clip((threshold - start) / steep, 0.0, 1.0)
    crosses = (start > threshold) != (end > threshold)
    ex, ey = x - _start(x), y - _start(y)
    by_square = 1.0 / (ex * ex + ey * ey + POINT**2)
    return Sweeps(
        x=_start(x),
        y=_start(y),
        ex=ex,
        ey=ey,
        ax=ex * by_square,
        ay=ey * by_square,
        low=jnp.where(crosses & (sink > 0.0), crossing, 0.0),
        high=jnp.where(crosses & (sink < 0.0), crossing, 1.0),
        press=_start(force),
        gain=force - _start(force),
        time=_start(time),
        span=time - _start(time),
        depth=jnp.where(known & _start(known), jnp.maximum(start, end), -FAR),
    )


def before(sweeps: Sweeps) -> Sweeps:
    """The sweeps of the same bristles one stamp earlier; before the first there is none."""

    def moved(x, fill):
        return jnp.concatenate([jnp.full_like(x[:1], fill), x[:-1]])

    earlier = jax.tree.map(lambda x: moved(x, 0.0), sweeps)
    return dataclasses.replace(earlier, x=moved(sweeps.x, FAR), depth=moved(sweeps.depth, -FAR))


def nearest(sweep: Sweeps, x, y):
    """(share, square distance [pixels^2]) of the part of a sweep that touches, next to pixels."""
    rx, ry = x - sweep.x, y - sweep.y
    share = jnp.clip(rx * sweep.ax + ry * sweep.ay, sweep.low, sweep.high)
    dx, dy = rx - share * sweep.ex, ry - share * sweep.ey
    return share, dx * dx + dy * dy


def exit_share(sweep: Sweeps, x, y, radius):
    """Share of a sweep at which a bristle of `radius` [pixels] last covers pixels x, y."""
    rx, ry = x - sweep.x, y - sweep.y
    square = sweep.ex * sweep.ex + sweep.ey * sweep.ey + POINT**2
    across = (rx * sweep.ey - ry * sweep.ex) ** 2 / square
    # Near the rim the chord shrinks like a square root; it is cut off where its slope is steep.
    chord = jnp.sqrt(jnp.maximum(radius * radius - across, 0.1 * radius * radius))
    share = rx * sweep.ax + ry * sweep.ay + chord / jnp.sqrt(square)
    return jnp.clip(share, sweep.low, sweep.high)
