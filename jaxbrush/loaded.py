"""The track of a loaded brush, and what the networks are told of it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.brush import BristleTrack, BrushParams
from jaxbrush.canvas import Canvas, to_srgb
from jaxbrush.film import laid_film
from jaxbrush.paint import RELIEF
from jaxbrush.paint.state import TUNED_AREA, TUNED_HAIRS
from jaxbrush.pickup import picked_up
from jaxbrush.raster import Grid, trajectory_maps
from jaxbrush.structs import state
from jaxbrush.stylus import Stroke, way

COAT = 0.2
"""[mm] above the canvas at which the paint on a bristle touches it."""
LOAD = 0.85
"""Share of what a brush holds that it is loaded with, where nothing else is said."""
REACH = 8
"""Pixels beyond the bristles that a stroke may change: how far the mask is dilated."""


@state
class Loaded(BristleTrack):
    """The track of a loaded brush. hairs: (t,) of the simulator's paint constants that a bristle
    stands for, of `TUNED_HAIRS` on `TUNED_AREA`: what it lays where it sweeps goes with them. load:
    (t,) share of what it holds that the brush was loaded with. relief: (t,) depth of the weave
    [mm]."""

    hairs: jax.Array
    load: jax.Array
    relief: jax.Array


def loaded(track: BristleTrack, brush: BrushParams, load=LOAD, relief=RELIEF) -> Loaded:
    """The track as maps of a loaded brush see it: a bristle touches where its coat of paint does,
    `COAT` above the canvas, there without force."""
    near = (track.position[:, :, 2] < COAT) & track.valid[:, None, None]
    own = {f.name: getattr(track, f.name) for f in dataclasses.fields(track)}
    own["force"] = jnp.where(near, jnp.maximum(track.force, 1e-3), 0.0)
    each = brush.area / track.position.shape[-1] * np.float32(TUNED_HAIRS / TUNED_AREA)
    every = jnp.ones_like(track.time)
    load, relief = jnp.asarray(load, float) * every, jnp.asarray(relief, float) * every
    return Loaded(**own, hairs=each * every, load=load, relief=relief)


def drawn_maps(grid: Grid, track: Loaded, canvas: Canvas, color, edge=None, laid=None):
    """Maps as the networks are told them.

    Args:
      grid: pixels, as large as those of the canvas; all that the stroke touches of it, or else with
        `laid`. canvas: (h, w) before the stroke, all of it. color: (3,) of the paint, linear RGB.
        edge: as in `trajectory_maps`. laid: film and hair on the grid, as of `laid_film`, which
        they else come from.

    Returns:
      (dict of pressure, sweeps by hairs in place of bristles, time by the track's clock, load where
      the brush came, tip, film, hair, lift (h, w), trajectory and picked (h, w, 3) in sRGB;
      TrajectoryMaps).
    """
    picked, lift = picked_up(track, canvas, grid.pixel, COAT)
    tip = jnp.clip(track.position[:, -1, 2], 0.0, COAT)
    carried = jnp.concatenate([to_srgb(picked), lift[..., None], tip[..., None]], axis=-1)
    maps = trajectory_maps(grid, track, carried, edge=edge)
    end = jnp.max(jnp.where(track.valid, track.time, 0.0))
    if laid is None:
        one = track.hairs[0], track.load[0]
        laid = laid_film(grid, track, *one, canvas.height, track.relief[0])
    film, hair = laid
    return {
        "pressure": maps.pressure,
        "sweeps": track.hairs[0] * maps.sweeps,
        "time": end * maps.time,
        "load": track.load[0] * maps.coverage,
        "trajectory": maps.coverage[..., None] * to_srgb(jnp.asarray(color, float))[None, None],
        "picked": maps.color[..., :3],
        "lift": maps.color[..., 3],
        "tip": maps.color[..., 4],
        # Rounding, and two ways that paint leaves a thin film, take it some µm below.
        "film": jnp.maximum(film, 0.0),
        "hair": hair,
    }, maps


def on_way(track: BristleTrack, stroke: Stroke, depth) -> BristleTrack:
    """The track with the way of the handle [mm] for its clock.

    Paint is dragged by the way, not by the time a hand takes; and the way so far is known while
    the stroke goes on, where the paper's share of its duration is not.

    Args:
      stroke: that the track follows. depth: of the brush at full pressure [mm].
    """
    return dataclasses.replace(track, time=way(stroke, depth))
