"""Strokes of a stylus: what the hand did, resampled into stamps, moved about, or invented.

A `Stroke` has fixed shapes, so every function here is written for one stroke and the caller vmaps.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.structs import state

SAMPLE_INTERVAL = 0.008  # s, what a tablet gives

KINDS = ("straight", "arc", "s_curve", "hook", "scribble", "dab")

# What a stroke of each kind is made of: a number is drawn between each low and high.
# length: mean arc length [mm]; pace: factor on speed; then turns of the heading [rad]: a steady
# bend, a swing there and back, a late hook, a zigzag with its number of cycles.
_RANGES = {
    #          straight      arc           s_curve       hook          scribble      dab
    "length": ((14.0, 40.0), (16.0, 50.0), (20.0, 50.0), (15.0, 35.0), (60.0, 180.0), (0.8, 3.5)),
    "pace": ((0.8, 1.3), (0.8, 1.2), (0.8, 1.2), (0.7, 1.1), (1.0, 1.4), (0.4, 0.9)),
    "bend": ((0.0, 0.25), (0.6, 2.6), (0.0, 0.4), (0.0, 0.4), (0.0, 0.5), (0.0, 0.8)),
    "swing": ((0.0, 0.0), (0.0, 0.0), (0.9, 1.8), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0)),
    "hook": ((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (1.6, 2.8), (0.0, 0.0), (0.0, 0.0)),
    "zigzag": ((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (1.3, 1.55), (0.0, 0.0)),
    "cycles": ((1.0, 1.0), (1.0, 1.0), (1.0, 1.0), (1.0, 1.0), (2.0, 5.0), (1.0, 1.0)),
}
_KIND_WEIGHTS = (0.25, 0.25, 0.15, 0.1, 0.15, 0.1)
_DRAWS = 69
_PATH_POINTS = 512  # resolves the corners of the quickest zigzag

# A last step this much longer than one, in stamp units, is rounding and not worth a stamp.
_ROUNDING = 1e-3
# Segments shorter than this, in stamp units, are points: dividing by them only amplifies rounding.
_POINT = 1e-6


@state
class Stroke:
    """The path of a handle over the canvas; x right, y down, z up out of the canvas.

    The handle axis points from the canvas to the hand, along (cos(altitude) cos(azimuth),
    cos(altitude) sin(azimuth), sin(altitude)). The brush frame is the minimal rotation that takes
    +z to that axis, applied after a rotation by `twist` about z.

    Attributes:
      time: (t,) [s], not decreasing.
      position: (t, 2) x, y where the axis meets the canvas [mm].
      pressure: (t,) in [0, 1].
      altitude: (t,) [rad] above the canvas, in [0, pi/2]; pi/2 is perpendicular.
      azimuth: (t,) [rad], 0 along +x and growing towards +y; any turn.
      twist: (t,) [rad] about the handle axis; any turn.
      valid: (t,) bool, True for the samples and False for the padding that follows them and
        repeats the last one.
    """

    time: jax.Array
    position: jax.Array
    pressure: jax.Array
    altitude: jax.Array
    azimuth: jax.Array
    twist: jax.Array
    valid: jax.Array


def make_stroke(
    position, time=None, pressure=0.5, altitude=np.pi / 2, azimuth=0.0, twist=0.0, valid=True
) -> Stroke:
    """Builds a stroke of JAX's default float type, broadcasting scalars over the samples.

    Args:
      position: (t, 2) [mm], t >= 1.
      time: (t,) [s]; by default samples are 8 ms apart.
      pressure: (t,) or scalar, in [0, 1].
      altitude: (t,) or scalar [rad], in [0, pi/2].
      azimuth: (t,) or scalar [rad].
      twist: (t,) or scalar [rad].
      valid: (t,) or scalar bool.
    Returns:
      The stroke.
    Raises:
      ValueError: when a shape does not fit.
    """
    position = jnp.asarray(position, float)
    if position.ndim != 2 or position.shape[0] < 1 or position.shape[1] != 2:
        raise ValueError(f"position has shape {position.shape}, expected (t, 2) with t >= 1")
    count = position.shape[0]
    if time is None:
        time = SAMPLE_INTERVAL * jnp.arange(count, dtype=float)
    time = jnp.asarray(time, float)
    if time.shape != (count,):
        raise ValueError(f"time has shape {time.shape}, expected ({count},)")

    def along(name, value, dtype=float):
        value = jnp.asarray(value, dtype)
        if value.shape not in ((), (count,)):
            raise ValueError(f"{name} has shape {value.shape}, expected () or ({count},)")
        return jnp.broadcast_to(value, (count,))

    return Stroke(
        time=time,
        position=position,
        pressure=along("pressure", pressure),
        altitude=along("altitude", altitude),
        azimuth=along("azimuth", azimuth),
        twist=along("twist", twist),
        valid=along("valid", valid, bool),
    )


def pad(stroke: Stroke, count: int) -> Stroke:
    """Lengthens a stroke to `count` samples, so that strokes of several lengths stack.

    Args:
      stroke: t samples, t <= count.
      count: static number of samples wanted.
    Returns:
      The stroke with `count` samples; the new ones repeat the last and are not valid.
    Raises:
      ValueError: when the stroke is longer than `count`.
    """
    extra = count - stroke.time.shape[0]
    if extra < 0:
        raise ValueError(f"count is {count}, expected at least the stroke's {count - extra}")

    def longer(x):
        return jnp.concatenate([x, jnp.repeat(x[-1:], extra, axis=0)])

    valid = jnp.concatenate([stroke.valid, jnp.zeros(extra, bool)])
    return dataclasses.replace(jax.tree.map(longer, stroke), valid=valid)


def stamps_needed(stroke: Stroke, spacing, max_dt, depth=0.0) -> jax.Array:
    """Counts the stamps that `resample` needs to keep the spacing asked for.

    Args:
      stroke: t samples.
      spacing: largest arc length between stamps [mm], > 0.
      max_dt: longest time between stamps [s], > 0.
      depth: as for `resample`.
    Returns:
      () int32; 0 for a stroke without a valid sample.
    """
    return _stamps(stroke, _progress(stroke, spacing, max_dt, depth))


def way(stroke: Stroke, depth=0.0) -> jax.Array:
    """How far the handle has come at each sample, (t,) [mm] from 0, as `resample` measures it.

    Args:
      stroke: t samples. depth: as for `resample`.
    """
    return _progress(stroke, 1.0, jnp.inf, depth)


def resample(stroke: Stroke, count: int, spacing, max_dt, depth=0.0) -> Stroke:
    """Places stamps at equal arc length, or at equal time where the hand is slow.

    The stroke is measured in stamp units, u = sum over segments of max(ds / spacing, dt / max_dt).
    Stamps lie at u = 0, 1, 2, ... and at the stroke's end. Differentiable in everything but
    `valid`; no value or gradient is NaN for repeated samples, repeated times or a single sample.

    Args:
      stroke: t samples.
      count: static number of samples of the result, >= 2. A stroke that needs more stamps gets
        `count`, spread evenly in u: coarser than asked, never cut short.
      spacing: arc length between stamps [mm], > 0.
      max_dt: longest time between stamps [s], > 0; may be infinite.
      depth: way of the handle up or down for a change of pressure by 1 [mm], part of the arc
        length: a brush that lifts steeply moves its tips, too.
    Returns:
      The stamps, `count` samples, `valid` where used. Everything is interpolated linearly, angles
      the short way round, so azimuth and twist may leave [-pi, pi].
    Raises:
      ValueError: when count < 2.
    """
    if count < 2:
        raise ValueError(f"count is {count}, expected at least 2 stamps")
    u = _progress(stroke, spacing, max_dt, depth)
    stamps = _stamps(stroke, u)
    last = jnp.clip(stamps - 1, 0, count - 1)
    step = jnp.maximum(1.0, u[-1] / (count - 1))
    index = jnp.arange(count, dtype=jnp.int32)
    target = jnp.minimum(index.astype(u.dtype) * step, u[-1])

    # The segment after the last sample is empty, which makes one sample an ordinary stroke.
    j = jnp.clip(jnp.searchsorted(u, target, side="right") - 1, 0, u.shape[0] - 1)
    length = _after(u)[j] - u[j]
    long = length > _POINT
    weight = jnp.where(long, (target - u[j]) / jnp.where(long, length, 1.0), 0.0)
    end = jnp.maximum(jnp.sum(stroke.valid) - 1, 0)

    def at_stamps(x):
        w, inside = weight, index < last
        if x.ndim == 2:
            w, inside = w[:, None], inside[:, None]
        # The end is taken, not interpolated: exact, and free of the stroke length's gradient.
        return jnp.where(inside, x[j] + w * (_after(x)[j] - x[j]), x[end][None])

    return Stroke(
        time=at_stamps(stroke.time),
        position=at_stamps(stroke.position),
        pressure=at_stamps(stroke.pressure),
        altitude=at_stamps(stroke.altitude),
        azimuth=at_stamps(_unwrap(stroke.azimuth)),
        twist=at_stamps(_unwrap(stroke.twist)),
        valid=(index <= last) & (stamps > 0),
    )


def transform(
    stroke: Stroke, rotate=0.0, translate=(0.0, 0.0), scale=1.0, mirror=False, center=(0.0, 0.0)
) -> Stroke:
    """Mirrors, scales and rotates a stroke about `center`, then moves it; the tilt follows.

    With R the turn about z, the brush frame F becomes R F; mirrored with M = diag(-1, 1, 1) it
    becomes M F M, which is the mirrored brush for brushes that are symmetric in their own x.

    Args:
      stroke: t samples.
      rotate: angle from +x towards +y [rad].
      translate: (2,) [mm].
      scale: factor on positions, > 0; time, pressure and angles stay.
      mirror: bool, may be traced; flips x.
      center: (2,) fixed point of the mirror, scale and rotation [mm].
    Returns:
      The moved stroke.
    """
    dtype = stroke.position.dtype
    translate, center = jnp.asarray(translate, dtype), jnp.asarray(center, dtype)
    rotate, mirror = jnp.asarray(rotate, dtype), jnp.asarray(mirror, bool)
    x, y = ((stroke.position - center[None]) * jnp.asarray(scale, dtype)).T
    x = jnp.where(mirror, -x, x)
    cos, sin = jnp.cos(rotate), jnp.sin(rotate)
    turned = jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
    return dataclasses.replace(
        stroke,
        position=turned + (center + translate)[None],
        azimuth=jnp.where(mirror, jnp.pi - stroke.azimuth, stroke.azimuth) + rotate,
        twist=jnp.where(mirror, -stroke.twist, stroke.twist) + rotate,
    )


def random_stroke(key, count: int = 128, extent=60.0, kind=None) -> Stroke:
    """Invents a stroke as a right-handed painter might make it.

    Heading as a function of arc length gives the path. Speed follows the two-thirds power law
    (slower where the path bends; Lacquaniti et al. 1983) inside a bell close to the minimum-jerk
    profile (Flash and Hogan 1985), entered and left in flight; longer strokes are faster. The
    level of speed is that of a recorded sketch (contact speed: median 88, 95 % 280, largest
    477 mm/s); pressure is somewhat heavier than recorded there (median peak 0.37), because oil
    paint takes more than ink. Chosen to look right, not fitted to a population.

    Args:
      key: random key.
      count: static number of samples, evenly spaced in time, >= 2.
      extent: scalar or (2,) width, height [mm]; the stroke lies in [0, extent].
      kind: index into KINDS, may be traced; drawn at random when None.
    Returns:
      The stroke, every sample valid, time from 0.
    Raises:
      ValueError: when count < 2 or a static kind is out of range.
    """
    if count < 2:
        raise ValueError(f"count is {count}, expected at least 2 samples")
    if isinstance(kind, int) and not 0 <= kind < len(KINDS):
        raise ValueError(f"kind is {kind}, expected an index below {len(KINDS)}")
    # One draw for all: each call to the generator costs the compiler as much as the rest.
    draws = jax.random.uniform(key, (_DRAWS,))
    choice, path, timing, press, tilt = jnp.split(draws, [1, 34, 37, 48])
    if kind is None:
        kind = jnp.searchsorted(jnp.cumsum(jnp.array(_KIND_WEIGHTS[:-1])), choice[0])
    path, pace = _random_path(path, kind, jnp.broadcast_to(jnp.asarray(extent, float), 2))
    position, duration = _random_timing(timing, path, pace, count)
    tau = jnp.linspace(0.0, 1.0, count)
    altitude, azimuth, twist = tilt.reshape(3, 7)
    return Stroke(
        time=duration * tau,
        position=position,
        pressure=_random_pressure(press, tau),
        altitude=_around(altitude, tau, 0.87, 1.31, 0.07),
        azimuth=_around(azimuth, tau, 0.4, 1.2, 0.15),
        twist=_around(twist, tau, -np.pi / 2, np.pi / 2, 0.2),
        valid=jnp.ones(count, bool),
    )


def _random_path(draws, kind, extent):
    """Draws a path (2, _PATH_POINTS) [mm] inside extent (2,), and the factor on its speed."""
    mix, side, more, place, legs, uneven, wobble = jnp.split(draws, [7, 10, 13, 15, 21, 27])
    low, high = jnp.moveaxis(jnp.asarray(list(_RANGES.values()))[:, kind], -1, 0)
    draw = dict(zip(_RANGES, _between(mix, low, high), strict=True))
    side = jnp.where(side < 0.5, -1.0, 1.0)
    start, late, width = _between(more, [0.0, 0.7, 0.03], [6.28, 0.85, 0.06])

    s = jnp.linspace(0.0, 1.0, _PATH_POINTS)
    uneven = _drift(uneven, s)
    # An even zigzag looks ruled: the legs differ in length and in slant.
    phase = 2 * jnp.pi * (draw["cycles"] * s + 0.25) + 0.8 * _drift(legs, 2 * s)
    heading = (
        start
        + side[0] * draw["bend"] * (s + 0.12 * uneven)
        + side[1] * draw["swing"] * jnp.sin(jnp.pi * s)
        + side[2] * draw["hook"] * jax.nn.sigmoid((s - late) / width)
        + draw["zigzag"] * (1.0 + 0.12 * uneven) * jnp.tanh(2.5 * jnp.sin(phase))
        + 0.07 * _drift(wobble, 1.5 * s)
    )
    steps = jnp.stack([jnp.cos(heading), jnp.sin(heading)])[:, :-1] / (_PATH_POINTS - 1)
    path = jnp.pad(jnp.cumsum(draw["length"] * steps, axis=1), ((0, 0), (1, 0)))
    path = path - jnp.min(path, axis=1, keepdims=True)
    path = path * jnp.minimum(1.0, jnp.min(0.98 * extent / jnp.max(path, axis=1)))
    return path + (place * (extent - jnp.max(path, axis=1)))[:, None], draw["pace"]


def _random_timing(draws, path, pace, count):
    """Draws points (count, 2) [mm] on path (2, n), at even times, and the duration [s]."""
    n = path.shape[1]
    step = jnp.diff(path, axis=1)
    length = jnp.sum(jnp.hypot(*step))
    cosine = jnp.sum(step[:, 1:] * step[:, :-1], axis=0)
    sine = step[0, :-1] * step[1, 1:] - step[1, :-1] * step[0, 1:]
    curvature = jnp.pad(jnp.arctan2(sine, cosine), (0, 1), mode="edge") * (n - 1) / length  # 1/mm
    power_law = (1.0 + (10.0 * curvature) ** 2) ** (-1 / 6)

    level, enter, leave = _between(draws, [-0.8, 0.01, 0.01], [0.8, 0.15, 0.15])
    s = enter + (1.0 - leave - enter) * jnp.linspace(0.0, 1.0, n)[:-1]
    bell = (4.0 * s * (1.0 - s)) ** (2 / 3)
    slowness = 1.0 / (bell * power_law)
    time = jnp.pad(jnp.cumsum(slowness) / jnp.sum(slowness), (1, 0))
    mean = 88.0 * pace * jnp.sqrt(length / 26.0) * jnp.exp(level)
    peak = mean * jnp.mean(slowness) / jnp.min(slowness)
    mean = mean * jnp.minimum(1.0, 470.0 / peak)
    way = jnp.linspace(0.0, 1.0, n)
    at = jnp.interp(jnp.linspace(0.0, 1.0, count), time, way)
    return jnp.stack([jnp.interp(at, way, x) for x in path], axis=-1), length / mean


def _random_pressure(draws, tau):
    """Draws the pressure at times tau (t,) in [0, 1]: a rise, a slow wandering, a fall."""
    peak, rise, fall, first, last = _between(
        draws[:5], [np.log(0.25), 0.06, 0.1, 0.08, 0.03], [np.log(0.8), 0.25, 0.4, 0.5, 0.3]
    )

    def ramp(x):
        x = jnp.clip(x, 0.0, 1.0)
        return x * x * (3.0 - 2.0 * x)

    onset = first + (1.0 - first) * ramp(tau / rise)
    release = last + (1.0 - last) * ramp((1.0 - tau) / fall)
    shape = onset * release * (1.0 + 0.2 * _drift(draws[5:], tau))
    return jnp.exp(peak) * shape / jnp.max(shape)


def _around(draws, tau, low, high, wander):
    """Draws a level between low and high, and a slow drift of size `wander` about it, (t,)."""
    return _between(draws[0], low, high) + wander * _drift(draws[1:], tau)


def _drift(draws, tau):
    """Draws a smooth wandering in [-1, 1] at tau (t,), of about one to three waves in [0, 1]."""
    waves = _between(draws[:3], [0.3, 1.0, 2.0], [1.0, 2.0, 3.0])
    angle = 2 * jnp.pi * (tau[:, None] * waves[None] + draws[None, 3:])
    return jnp.sum(jnp.array([[0.57, 0.29, 0.14]]) * jnp.sin(angle), axis=-1)


def _between(draws, low, high):
    """Stretches draws from [0, 1] to [low, high]."""
    low, high = jnp.asarray(low, float), jnp.asarray(high, float)
    return low + (high - low) * draws


def _after(x):
    """Gives each entry of x (t, ...) its follower, and the last one itself."""
    return jnp.concatenate([x[1:], x[-1:]])


def _unwrap(angle):
    """Adds whole turns to angle (t,) [rad] so that no step is longer than half a turn."""
    turns = jnp.round(jnp.diff(angle) / (2 * jnp.pi))
    return angle - 2 * jnp.pi * jnp.concatenate([jnp.zeros_like(angle[:1]), jnp.cumsum(turns)])


def _progress(stroke, spacing, max_dt, depth):
    """Measures the way from the start to each sample in stamp units, (t,)."""
    dtype = stroke.position.dtype
    for name, value in (("spacing", spacing), ("max_dt", max_dt)):
        if not isinstance(value, jax.core.Tracer) and not np.all(np.asarray(value) > 0):
            raise ValueError(f"{name} is {value}, expected a number above 0")
    square = jnp.sum(jnp.diff(stroke.position, axis=0) ** 2, axis=-1)
    square = square + (depth * jnp.diff(stroke.pressure)) ** 2
    moved = square > 0
    way = jnp.where(moved, jnp.sqrt(jnp.where(moved, square, 1.0)), 0.0)
    both = stroke.valid[1:] & stroke.valid[:-1]
    step = jnp.maximum(
        way / jnp.asarray(spacing, dtype), jnp.diff(stroke.time) / jnp.asarray(max_dt, dtype)
    )
    return jnp.concatenate([jnp.zeros_like(way, shape=1), jnp.cumsum(jnp.where(both, step, 0.0))])


def _stamps(stroke, u):
    """Counts the stamps at u = 0, 1, 2, ... and the end of u (t,)."""
    steps = jnp.maximum(jnp.ceil(u[-1] - _ROUNDING), 0.0)
    return jnp.where(jnp.any(stroke.valid), steps.astype(jnp.int32) + 1, 0)
