"""From stylus to handle: where the ferrule is, how it is turned, how fast it moves."""

import jax
import jax.numpy as jnp

from jaxbrush.brush.shapes import BrushParams
from jaxbrush.structs import state
from jaxbrush.stylus import Stroke

APPROACH_DT = 1e-3
"""Time of one lowering step before the first stamp, and of a padded stamp [s]."""
SMALLEST_DT = 1e-5
"""Repeated device times are read as this far apart [s]."""


@state
class Pose:
    """The ferrule at the end of a stamp, or of many (leading axes).

    origin: (3,) centre of the ferrule's clamp plane [mm], z up from the canvas. rotation: (3, 3)
    from brush to canvas axes. dt: () duration of the stamp [s]. velocity: (3,) mean velocity
    over the stamp [mm/s]. jump: (3,) velocity less that of the stamp before [mm/s].
    """

    origin: jax.Array
    rotation: jax.Array
    dt: jax.Array
    velocity: jax.Array
    jump: jax.Array


def frame(altitude, azimuth, twist):
    """Rotation from brush axes (+z up the handle) to canvas axes.

    The least rotation that takes +z to the handle, after a turn by `twist` about +z; smooth
    down to a handle that lies on the canvas.

    Args:
      altitude: () [rad], pi/2 is perpendicular to the canvas. azimuth: () [rad] from +x to +y.
      twist: () [rad].

    Returns:
      (3, 3) rotation matrix.
    """
    x = jnp.cos(altitude) * jnp.cos(azimuth)
    y = jnp.cos(altitude) * jnp.sin(azimuth)
    z = jnp.sin(altitude)
    k = 1.0 / (1.0 + z)
    swing = jnp.array(
        [[1.0 - k * x * x, -k * x * y, x], [-k * x * y, 1.0 - k * y * y, y], [-x, -y, z]]
    )
    c, s = jnp.cos(twist), jnp.sin(twist)
    turn = jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return jnp.matmul(swing, turn, precision=jax.lax.Precision.HIGHEST)


def _reach(params: BrushParams, rotation):
    """Height of the ferrule at which the lowest undeformed tip just touches, (t,) [mm]."""
    tip = params.root + params.length[None] * jnp.mean(params.rest, axis=0)
    down = rotation[:, 2, :, None] * tip[None]
    return -jnp.min(jnp.sum(down, axis=1), axis=1)


def poses(params: BrushParams, stroke: Stroke, approach: int, press: bool = True) -> Pose:
    """Handle poses of a stroke, with `approach` lowering steps before its first stamp.

    The stylus position is where the axis of the undeformed brush meets the canvas. The ferrule
    stands `press_depth * pressure` below the height of first touch; without `press` it stays
    at first touch and the caller lowers it.

    Args:
      params: brush parameters.
      stroke: t stamps.
      approach: number of lowering steps k; the brush comes down on the first stamp's place.
      press: whether pressure sets the depth.

    Returns:
      Pose with leading axis k + t.
    """
    dtype = params.length.dtype
    first = jnp.zeros(approach, int)
    index = jnp.concatenate([first, jnp.arange(stroke.time.shape[0])])
    rotation = jax.vmap(frame)(stroke.altitude, stroke.azimuth, stroke.twist)
    reach = _reach(params, rotation)[index]
    rotation = rotation[index]
    ramp = jnp.concatenate(
        [jnp.arange(approach, dtype=dtype) / max(approach, 1), jnp.ones_like(stroke.pressure)]
    )
    depth = params.press_depth * stroke.pressure[index] * ramp if press else jnp.zeros_like(ramp)
    length = jnp.mean(params.length)
    place = stroke.position[index] + rotation[:, :2, 2] * length
    origin = jnp.concatenate([place, (reach - depth)[:, None]], axis=1).astype(dtype)

    before = stroke.time - jnp.concatenate([stroke.time[:1] - APPROACH_DT, stroke.time[:-1]])
    stamp_dt = jnp.where(
        stroke.valid, jnp.where(before > 0.01 * SMALLEST_DT, before, SMALLEST_DT), APPROACH_DT
    )
    dt = jnp.concatenate([jnp.full(approach, APPROACH_DT), stamp_dt]).astype(dtype)
    step = jnp.concatenate([origin[1:2] - origin[:1], origin[1:] - origin[:-1]])
    velocity = step / dt[:, None]
    jump = velocity - jnp.concatenate([velocity[:1], velocity[:-1]])
    return Pose(origin=origin, rotation=rotation.astype(dtype), dt=dt, velocity=velocity, jump=jump)


def turned(rotation, vectors):
    """`rotation` (3, 3) applied to the second-to-last axis of (..., 3, b)."""
    column = rotation.reshape((1,) * (vectors.ndim - 2) + (3, 3, 1))
    return (
        column[..., 0, :] * vectors[..., 0:1, :]
        + column[..., 1, :] * vectors[..., 1:2, :]
        + column[..., 2, :] * vectors[..., 2:3, :]
    )
