"""Trajectory maps: what a stroke's bristles did over each pixel (paper 4.1, Figures 3 and 4)."""

import jax
import jax.numpy as jnp

from jaxbrush.raster import exact, soft
from jaxbrush.raster.grid import Grid
from jaxbrush.raster.sweeps import sweeps_of
from jaxbrush.structs import state

FORCE_UNIT = 200.0
"""[µN] that `pressure` counts in: a default hog bristle's tip bent by 5 mm."""
WIDTH = 0.3
"""Default width that a bristle sweeps [mm]: a hair and the paint on it."""


@state
class TrajectoryMaps:
    """Maps of one stroke on a grid of h x w pixels; 0 where no bristle touched.

    pressure: (h, w) normal force of the latest bristle over the pixel, in `FORCE_UNIT`.
    sweeps: (h, w) how many times a bristle came over the pixel.
    color: (h, w, c) what the latest bristle carried.
    time: (h, w) when the latest bristle left the pixel: 0 at the stroke's start, 1 at its end.
    coverage: (h, w) share of the pixel that was touched; 0 or 1 in exact maps. In soft maps the
    others are multiplied by it.
    whole: () False when bristles moved further from stamp to stamp than soft maps reach, so that
    these have gaps.
    """

    pressure: jax.Array
    sweeps: jax.Array
    color: jax.Array
    time: jax.Array
    coverage: jax.Array
    whole: jax.Array


def trajectory_maps(
    grid: Grid, track, color=(1.0, 1.0, 1.0), *, width: float = WIDTH, edge: float | None = None,
    nodes: int = 1, longest: float = 0.5,
) -> TrajectoryMaps:  # fmt: skip
    """Draws the bristles of a track.

    Between two stamps a bristle sweeps a capsule of its width, from where it lands to where it
    lifts. The value of a pixel is that of the bristle that leaves its centre last, at that moment.
    Exact maps tell moments of a 64th of the time between two stamps apart, and order the same
    moment by bristle. Soft maps lay whole sweeps, those of a stamp from the foremost bristle to
    the one that trails.

    Exact maps (`edge` None) are differentiable in forces, times and colors; which sweep is the
    latest, and coverage, have no slope. Soft maps are differentiable in positions too and tend to
    the exact ones as `edge` goes to 0. jit, and vmap with the patience that windows take there.

    Args:
      grid: pixels.
      track: BristleTrack of t stamps, b bristles.
      color: (c,), (b, c) or (t, b, c) that each bristle carries, such as linear RGB: one for all,
        one for each, or at each stamp.
      width: of what a bristle sweeps [mm], static.
      edge: width over which soft coverage falls from 1 to 0 [mm], static, or None for exact maps.
        The same width counts in height: a tip `edge` / 2 above the canvas begins to draw.
      nodes: how many nodes from the tip up draw; as many as the brush's contact nodes.
      longest: step between stamps, along x or y, that soft maps must reach [mm], static. Their
        windows are that much wider than a bristle, so time and memory grow with its square; steps
        beyond it leave gaps, and `whole` says so. Exact maps reach any.

    Returns:
      TrajectoryMaps in the float type of the track.

    Raises:
      ValueError: a track without stamps, widths that are not positive, `nodes` or `color` that do
        not fit the track, more sweeps than keys.
    """
    stamps, _, _, b = track.position.shape
    if stamps < 1:
        raise ValueError(f"a track of {stamps} stamps: expected at least 1")
    if not width > 0.0:
        raise ValueError(f"width = {width!r}: expected a positive width [mm]")
    if edge is not None and not 0.0 < edge <= 20.0 * width:
        raise ValueError(f"edge = {edge!r}: expected a width in (0, 20 x {width} mm], or None")
    if not longest > 0.0:
        raise ValueError(f"longest = {longest!r}: expected a positive length [mm]")
    color = jnp.asarray(color, track.position.dtype)
    if not 1 <= color.ndim <= 3 or color.shape[:-1] not in ((), (b,), (stamps, b)):
        raise ValueError(
            f"color has shape {color.shape}: expected (c,), ({b}, c) or ({stamps}, {b}, c)"
        )
    if color.ndim == 1:
        color = jnp.broadcast_to(color, (b, *color.shape))
    # Each node that draws is a bristle of its own, of the same color.
    color = jnp.tile(color, (nodes, 1))
    exact.check_keys(stamps, b * nodes)
    if edge is not None:
        return _soft(grid, track, color, width, edge, nodes, longest)

    radius = 0.5 * width / grid.pixel
    sweeps = sweeps_of(grid, track, nodes, 0.0)
    table = exact.table_of(sweeps, radius)
    still = jax.lax.stop_gradient(table)
    key, passes = exact.images(still, stamps, grid.shape, radius)
    force, time = exact.values(sweeps, table, key, radius)
    covered = key > 0
    stamp, bristle = exact.decode(key, b * nodes)
    # Where nothing draws, nothing is worn. Past a branch the colors are an array: what made them
    # would else be worked out again at every pixel.
    color = jax.lax.cond(jnp.any(covered), lambda x: x, jnp.zeros_like, color)
    worn = color[bristle] if color.ndim == 2 else color[stamp, bristle]
    dtype = force.dtype
    return TrajectoryMaps(
        pressure=force / FORCE_UNIT,
        sweeps=passes.astype(dtype),
        color=jnp.where(covered[..., None], worn, 0.0),
        time=time,
        coverage=covered.astype(dtype),
        whole=jnp.asarray(True),
    )


def _soft(grid, track, color, width, edge, nodes, longest):
    scale = 1.0 / grid.pixel
    sweeps = sweeps_of(grid, track, nodes, -0.5 * edge)
    found = soft.maps(sweeps, color, grid.shape, 0.5 * width * scale, edge * scale, edge,
                      longest * scale)  # fmt: skip
    return TrajectoryMaps(
        pressure=found.layers[1] / FORCE_UNIT,
        sweeps=found.passes,
        color=jnp.moveaxis(found.layers[3:], 0, -1),
        time=found.layers[2],
        coverage=found.layers[0],
        whole=found.whole,
    )
