"""Strokes with known paths, reference motion, and the error measures of the brush experiments."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.brush import BrushConfig, make_brush, rollout, stable_dt
from jaxbrush.stylus import make_stroke

KINDS = ("straight", "curve", "zigzag", "light", "dab")
DURATION = 0.2
"""[s] of every stroke."""
STAMP = 1e-3
"""Stamp interval of the reference and the default [s]."""

roll = jax.jit(rollout)


def _ease(x):
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def stroke_of(kind: str, interval: float = STAMP, duration: float = DURATION):
    """A stroke whose path is a formula in time, so that every stamp interval samples the same one.

    straight: a pull at 100 mm/s. curve: an arc at 120 mm/s with the handle turning along.
    zigzag: reversals whose speed grows from 100 to 480 mm/s. light: 150 mm/s at pressure 0.08.
    dab: pressed to 0.8 and lifted on one place. The handle leans at 55 degrees.

    Args:
      interval: between stamps [s]. duration: [s].

    Returns:
      Stroke with duration / interval stamps, in the default float type.
    """
    t = np.arange(round(duration / interval)) * interval
    u = t / DURATION
    zero = np.zeros_like(t)
    azimuth, twist = zero + 0.3, zero
    pressure = 0.02 + 0.43 * _ease(t / 0.05)
    if kind == "straight":
        x, y = 10.0 + 100.0 * t, 20.0 + zero
    elif kind == "curve":
        angle = 2.4 * u
        x, y = 20.0 + 10.0 * np.sin(angle), 20.0 - 10.0 * np.cos(angle)
        azimuth, twist = 0.3 + 1.2 * u, 0.9 * u
    elif kind == "zigzag":
        turn = (100.0 * t + 380.0 * t * t / (2.0 * DURATION)) / 8.0
        x, y = 20.0 + 8.0 * np.sin(turn), 10.0 + 60.0 * t
    elif kind == "light":
        x, y = 10.0 + 150.0 * t, 20.0 + zero
        pressure = 0.08 * _ease(t / 0.05)
    elif kind == "dab":
        x, y = 20.0 + 1.5 * u, 20.0 + zero
        pressure = 0.8 * np.sin(np.pi * u) ** 2
    else:
        raise ValueError(f"kind = {kind!r}: expected one of {KINDS}")
    return make_stroke(
        np.stack([x, y], 1), t, pressure, altitude=math.radians(55.0), azimuth=azimuth, twist=twist
    )


def single(tree):
    """The same tree with its floats in float32, outside of any double precision context."""

    def convert(x):
        x = np.asarray(x)
        return jnp.asarray(x.astype(np.float32) if x.dtype.kind == "f" else x)

    return jax.tree.map(convert, tree)


@functools.cache
def brush_of(shape: str, bristles: int, nodes: int = 12):
    """A brush in float64 numpy arrays, the same for every float type."""
    with jax.enable_x64(True):
        params = make_brush(jax.random.key(7), BrushConfig(nodes=nodes), shape, bristles)
        return jax.tree.map(np.asarray, params)


def stable_substeps(params, nodes: int, interval: float = STAMP) -> int:
    """The fewest explicit steps a stamp that are stable."""
    return math.ceil(interval / float(stable_dt(single(params), nodes - 1)))


@dataclasses.dataclass(frozen=True)
class Motion:
    """tip: (t, 3, b) [mm]. force: (t, b) normal force of each bristle at the stamps [µN]."""

    tip: np.ndarray
    force: np.ndarray

    def every(self, stride: int):
        return Motion(self.tip[::stride], self.force[::stride])


def motion_of(config: BrushConfig, track) -> Motion:
    """What is compared of a track. The last stamp is left out: explicit integrators give the mean
    force of a stamp, of which two neighbours make the force at the time between them."""
    force = np.asarray(track.force, np.float64).sum(1)
    if config.integrator in ("verlet", "symplectic_euler"):
        force = 0.5 * (force[:-1] + force[1:])
    else:
        force = force[:-1]
    return Motion(np.asarray(track.position[:-1, -1], np.float64), force)


def reference_of(params, kind: str, substeps: int, duration: float = DURATION) -> Motion:
    """Verlet in double precision, every node can touch; `substeps` steps in each ms stamp."""
    n = params.rest.shape[0]
    config = BrushConfig(nodes=n + 1, contact_nodes=n, integrator="verlet", substeps=substeps)
    with jax.enable_x64(True):
        double = jax.tree.map(jnp.asarray, params)
        return motion_of(config, roll(config, double, stroke_of(kind, STAMP, duration)))


@dataclasses.dataclass(frozen=True)
class Errors:
    """tip: rms distance of the tips, share of the bristle length. force: rms error of the total
    normal force over its rms. bristle: the same of each bristle's force. All in percent."""

    tip: float
    force: float
    bristle: float

    @property
    def finite(self):
        return all(math.isfinite(x) for x in dataclasses.astuple(self))


def _relative(value, true):
    with np.errstate(all="ignore"):
        return 100.0 * float(np.sqrt(np.mean((value - true) ** 2) / np.mean(true**2)))


def errors(motion: Motion, reference: Motion, length: float) -> Errors:
    """Errors of a motion at the same stamps as the reference; length: of a bristle [mm]."""
    with np.errstate(all="ignore"):
        apart = np.sum((motion.tip - reference.tip) ** 2, axis=1)
        tip = 100.0 * float(np.sqrt(np.mean(apart))) / length
    return Errors(
        tip=tip,
        force=_relative(motion.force.sum(1), reference.force.sum(1)),
        bristle=_relative(motion.force, reference.force),
    )


def compare(config, params, kind, reference, interval: float = STAMP) -> Errors:
    """Errors of `config` in float32 on stroke `kind` at stamps `interval` apart [s], measured at
    the stamps that it shares with the reference."""
    ratio = interval / STAMP
    with jax.enable_x64(True):
        stroke = stroke_of(kind, interval)
    motion = motion_of(config, roll(config, single(params), single(stroke)))
    if ratio < 1.0:
        motion = motion.every(round(1.0 / ratio))
    shared = reference.every(max(round(ratio), 1))
    count = min(len(motion.tip), len(shared.tip))
    cut = lambda m: Motion(m.tip[:count], m.force[:count])  # noqa: E731
    return errors(cut(motion), cut(shared), float(np.mean(params.length)))


def pooled(many: list[Errors]) -> Errors:
    """Root mean square over strokes."""
    table = np.array([dataclasses.astuple(e) for e in many])
    with np.errstate(all="ignore"):
        return Errors(*(float(x) for x in np.sqrt(np.mean(table**2, axis=0))))
