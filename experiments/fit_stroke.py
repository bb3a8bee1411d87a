"""Reads a stroke out of its maps: the path and pressure of the hand, by gradient descent.

python -m experiments.fit_stroke            # six strokes, about 8 minutes on one core
python -m experiments.fit_stroke --quick    # one stroke
"""

import dataclasses
import time
from pathlib import Path
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from rich.progress import track as progress

from experiments.common import console, print_table, results_folder, write_run
from jaxbrush.brush import BrushConfig, make_brush, rollout
from jaxbrush.raster import FORCE_UNIT, Grid, make_grid, trajectory_maps
from jaxbrush.structs import config, state
from jaxbrush.stylus import KINDS, Stroke, make_stroke, random_stroke

PIXEL = 0.1
"""Side of a pixel of the maps that are read [mm]."""
SIDE = 51.2
"""Side of the canvas around a stroke [mm]."""
SCALES = (6, 12, 24, 48)
"""Control points of the cubic B-splines whose sum is a curve: Adam moves the whole stroke by the
first and bends it by the last."""
PRESSED = 0.05
"""A pen pressed less leaves next to nothing in the maps; its path is not asked for."""
BAR = 0.5 * PIXEL
"""Success: rms path error below half a pixel [mm]."""


@config
class Level:
    """How the maps are compared for some steps.

    pixel: side [mm]. edge: of soft coverage [mm]. blur: standard deviation of the blur that both
    sides get [mm]. waves: time enters as that many turns of a clock hand over the stroke. rate:
    learning rate at the start and end of the level [mm].
    """

    pixel: float
    edge: float
    blur: float
    waves: tuple[float, ...]
    steps: int
    rate: tuple[float, float]


LEVELS = (
    Level(0.8, 1.2, 1.6, (0.5, 1.0), 60, (0.25, 0.1)),
    Level(0.8, 0.8, 0.6, (1.0, 3.0), 60, (0.1, 0.04)),
    Level(0.4, 0.4, 0.0, (2.0, 6.0), 60, (0.04, 0.015)),
    Level(0.2, 0.2, 0.0, (2.0, 8.0), 80, (0.015, 0.001)),
)


@state
class Unknown:
    """What is looked for: control points at every scale. path: (k, 2) each [mm]. press: (k,)
    each, before the sigmoid."""

    path: tuple[jax.Array, ...]
    press: tuple[jax.Array, ...]


@config
class Setting:
    """What a fit compiles for. stamps of a stroke; longest: step of a tip [mm]."""

    brush: BrushConfig = BrushConfig()
    scales: tuple[int, ...] = SCALES
    longest: float = 1.0


def basis(stamps: int, count: int) -> np.ndarray:
    """Cubic B-splines with evenly spaced knots, (stamps, count); rows sum to 1."""
    at = np.linspace(0.0, count - 3.0, stamps)[:, None] - np.arange(-1, count - 1)[None]
    far = np.abs(at)
    near = 2.0 / 3.0 - far**2 + 0.5 * far**3
    return np.where(far < 1.0, near, np.clip(2.0 - far, 0.0, None) ** 3 / 6.0)


def _curve(points, stamps: int):
    total = 0.0
    for x in points:
        b = jnp.asarray(basis(stamps, x.shape[0]), x.dtype)
        total = total + jnp.matmul(b, x, precision="highest")
    return total


def stroke_of(unknown: Unknown, known: Stroke) -> Stroke:
    """The stroke of an unknown; its timing, tilt and twist are those of `known`."""
    stamps = known.time.shape[0]
    return dataclasses.replace(
        known,
        position=_curve(unknown.path, stamps),
        pressure=jax.nn.sigmoid(_curve(unknown.press, stamps)),
    )


def start_at(position, pressure: float, scales) -> Unknown:
    """An unknown whose path is `position` (t, 2) and whose pressure is constant."""
    left, path = np.asarray(position, float), []
    for k in scales:
        b = basis(len(left), k)
        # A little ridge keeps the points tame where splines are short of stamps.
        points = np.linalg.solve(b.T @ b + 1e-3 * np.eye(k), b.T @ left)
        left = left - b @ points
        path.append(jnp.asarray(points, float))
    level = float(np.log(pressure / (1.0 - pressure)))
    press = [jnp.full(k, level if i == 0 else 0.0) for i, k in enumerate(scales)]
    return Unknown(path=tuple(path), press=tuple(press))


def astray(key, stroke: Stroke, distance: float):
    """The path of a stroke shifted and bent until it is `distance` off (rms) where it presses."""
    turn, bend = jax.random.split(key)
    angle = jax.random.uniform(turn, maxval=2 * np.pi)
    shift = np.array([np.cos(angle), np.sin(angle)])
    wobble = basis(len(stroke.time), 7) @ np.asarray(jax.random.normal(bend, (7, 2)))
    offset = shift + 0.7 * wobble
    pressed = np.asarray(stroke.pressure) > PRESSED
    rms = np.sqrt(np.mean(np.sum(offset**2, axis=1)[pressed]))
    return np.asarray(stroke.position) + distance / rms * offset


def features(maps, waves):
    """What is compared, (3 + 2 waves, h, w): coverage, pressure, and coverage times the hand of a
    clock that goes round `waves` times in a stroke: bounded at crossings, where time jumps."""
    cover = maps.coverage
    touched = cover > 1e-3
    time = jnp.where(touched, maps.time / jnp.where(touched, cover, 1.0), 0.0)
    rows = [cover, 2.0 * maps.pressure]
    for turns in waves:
        angle = 2 * np.pi * turns * time
        rows += [cover * jnp.cos(angle), cover * jnp.sin(angle)]
    return jnp.stack(rows)


def _blurred(images, sigma: float):
    """Images (c, n, n) blurred by a Gaussian, sigma [pixels]."""
    if sigma == 0.0:
        return images
    index = np.arange(images.shape[-1])
    kernel = np.exp(-0.5 * ((index[:, None] - index[None]) / sigma) ** 2)
    kernel = jnp.asarray(kernel / (sigma * np.sqrt(2.0 * np.pi)), images.dtype)
    return jnp.einsum("yv,cvu,xu->cyx", kernel, images, kernel, precision="highest")


def target_of(level: Level, exact):
    """What a level is compared with, from the exact maps: features averaged over its pixels."""
    rows = features(exact, level.waves)
    k = round(level.pixel / PIXEL)
    c, h, w = rows.shape
    rows = jnp.mean(rows.reshape(c, h // k, k, w // k, k), axis=(2, 4))
    return _blurred(rows, level.blur / level.pixel)


def compare(level: Level, longest: float, origin, target, track):
    """Loss of a track against a target, 1 where nothing is drawn, and whether maps are whole."""
    h, w = target.shape[1:]
    grid = Grid(shape=(h, w), origin=origin, pixel=level.pixel)
    maps = trajectory_maps(grid, track, edge=level.edge, longest=longest)
    rows = _blurred(features(maps, level.waves), level.blur / level.pixel)
    return jnp.sum((rows - target) ** 2) / jnp.sum(target**2), maps.whole


class Tools(NamedTuple):
    """The compiled parts of a fit; the brush's gradient, slow to compile, serves every level."""

    draw: object
    slope: object
    move: object
    optimizer: optax.GradientTransformation


def rates(levels):
    """The learning rate of each step: falls within a level, by a cosine."""
    ends = np.cumsum([level.steps for level in levels])[:-1]
    parts = [
        optax.cosine_decay_schedule(a.rate[0], a.steps, a.rate[1] / a.rate[0]) for a in levels
    ]
    return optax.join_schedules(parts, [int(n) for n in ends])


def make_tools(setting: Setting, levels) -> Tools:
    """Compiled functions of a fit: (unknown, known, brush) to track, its slope, one update."""
    optimizer = optax.chain(
        optax.zero_nans(), optax.adam(rates(levels), b1=0.8, b2=0.95)
    )

    def run(unknown, known, brush):
        track = rollout(setting.brush, brush, stroke_of(unknown, known))
        return track.position, track.force, track

    def draw(unknown, known, brush):
        return run(unknown, known, brush)[2]

    def slope(level, origin, target, track):
        def loss(position, force):
            drawn = dataclasses.replace(track, position=position, force=force)
            return compare(level, setting.longest, origin, target, drawn)

        return jax.value_and_grad(loss, (0, 1), has_aux=True)(track.position, track.force)

    def move(unknown, memory, known, brush, slope):
        _, back = jax.vjp(lambda u: run(u, known, brush)[:2], unknown)
        (gradient,) = back(slope)
        step, memory = optimizer.update(gradient, memory, unknown)
        return optax.apply_updates(unknown, step), memory, gradient

    return Tools(jax.jit(draw), jax.jit(slope, static_argnums=0), jax.jit(move), optimizer)


def fit(tools: Tools, levels, brush, known, exact, origin, start: Unknown, watch=None):
    """Descends through the levels; `watch(step, level, unknown, loss, whole)` sees every step.

    Returns:
      The unknown at the end.
    """
    unknown, memory, step = start, tools.optimizer.init(start), 0
    for level in levels:
        target = target_of(level, exact)
        for _ in range(level.steps):
            drawn = tools.draw(unknown, known, brush)
            (loss, whole), slope = tools.slope(level, origin, target, drawn)
            if watch is not None:
                watch(step, level, unknown, loss, whole)
            unknown, memory, _ = tools.move(unknown, memory, known, brush, slope)
            step += 1
    return unknown


def errors(unknown: Unknown, known: Stroke, true: Stroke) -> dict:
    """Path error rms and largest [mm] and pressure error rms, where the true pen presses."""
    found = stroke_of(unknown, known)
    pressed = np.asarray(true.pressure) > PRESSED
    off = np.linalg.norm(np.asarray(found.position) - np.asarray(true.position), axis=1)[pressed]
    press = (np.asarray(found.pressure) - np.asarray(true.pressure))[pressed]
    rms = lambda x: float(np.sqrt(np.mean(x**2)))  # noqa: E731
    return {"path": rms(off), "most": float(off.max()), "press": rms(press)}
