"""What the experiments on trajectory maps share: strokes, windows, finer samplings of a track."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.brush import rollout
from jaxbrush.raster import PIXEL, WIDTH, make_grid, stroke_grid, trajectory_maps
from jaxbrush.raster.sweeps import TIP_STIFFNESS
from jaxbrush.stylus import make_stroke, pad

STROKES = ("light", "heavy", "crossing", "fast", "dab", "turning", "scribble", "hook")
SIDE = 256
"""Pixels along a side of the window of every stroke."""
STEPS = (0.25, 0.5, 1.0, 2.0)
"""Steps that soft maps are made for [mm]; a stroke takes the least that it fits in."""


def _ease(x):
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def _along(points, u):
    """Smooth curve through points (n, 2) at shares u of their number (Catmull-Rom), (t, 2)."""
    points = np.asarray(points, float)
    padded = np.concatenate([2 * points[:1] - points[1:2], points, 2 * points[-1:] - points[-2:-1]])
    at = np.clip(u, 0.0, 1.0) * (len(points) - 1)
    k = np.minimum(at.astype(int), len(points) - 2)
    s = (at - k)[:, None]
    a, b, c, d = (padded[k + i] for i in range(4))
    return b + 0.5 * s * (c - a + s * (2 * a - 5 * b + 4 * c - d + s * (3 * (b - c) + d - a)))


def stroke_of(kind: str, count: int):
    """One of `STROKES`, `count` stamps, within about 25 mm; the flat brush leans across its width,
    so that both halves press alike.

    light, heavy: the same pull at pressure 0.16 and 0.75. crossing: a loop over its own start.
    fast: a flick at 480 mm/s, one stamp for four of the others. dab: down and up on one place.
    turning: a wave at 50 degrees of tilt while twist and azimuth turn. scribble: five reversals.
    hook: a pull that turns back and lifts.
    """
    stamps = max(count // 4, 2) if kind == "fast" else count
    u = np.linspace(0.0, 1.0, stamps)
    zero = np.zeros(stamps)
    altitude, azimuth, twist = math.radians(58.0), 0.0, math.pi / 2
    duration = 0.4
    place = np.stack([17.0 * u, -1.5 * np.sin(np.pi * u)], 1)
    if kind == "light":
        pressure = 0.16 * _ease(u / 0.1) * _ease((1.0 - u) / 0.15)
    elif kind == "heavy":
        pressure = 0.75 * _ease(u / 0.1) * _ease((1.0 - u) / 0.15)
    elif kind == "crossing":
        place = _along(
            [(0, 6), (5, 3), (11, -2), (12, -8), (7, -10), (3, -6), (6, 0), (11, 5), (16, 7)], u
        )
        twist, azimuth = math.pi / 4, -math.pi / 4
        pressure = 0.4 * _ease(u / 0.08) * _ease((1.0 - u) / 0.12)
    elif kind == "fast":
        place = np.stack([21.0 * u, -7.0 * u**2], 1)
        pressure = 0.5 * _ease(u / 0.15) * (1.02 - u) ** 1.2
        duration = 22.5 / 480.0
    elif kind == "dab":
        place = np.stack([1.2 * u, zero], 1)
        pressure = 0.9 * np.sin(np.pi * u) ** 2
    elif kind == "turning":
        place = np.stack([17.0 * u, 4.5 * np.sin(2.0 * np.pi * u)], 1)
        altitude, azimuth = math.radians(50.0), -0.6 + 1.8 * u
        twist = 0.3 * math.pi + 0.8 * math.pi * u
        pressure = 0.42 * _ease(u / 0.08) * _ease((1.0 - u) / 0.12)
    elif kind == "scribble":
        place = np.stack([12.0 * u, 5.0 * np.sin(5.0 * np.pi * u)], 1)
        twist, azimuth = 1.2, 1.2 - math.pi / 2
        pressure = (0.3 + 0.12 * np.sin(9.0 * u)) * _ease(u / 0.06) * _ease((1.0 - u) / 0.1)
    elif kind == "hook":
        place = _along([(0, 4), (6, 3), (12, 1), (15, -3), (12, -7), (8, -6.5)], u)
        azimuth = -1.1 * _ease((u - 0.45) / 0.4)
        twist = azimuth + math.pi / 2
        pressure = 0.45 * _ease(u / 0.08) * (1.0 - 0.8 * _ease((u - 0.3) / 0.7))
        pressure = pressure * _ease((1.0 - u) / 0.12)
    else:
        raise ValueError(f"kind = {kind!r}: expected one of {STROKES}")
    stroke = make_stroke(
        place, duration * u, pressure, altitude=altitude, azimuth=azimuth, twist=twist
    )
    return pad(stroke, count)


def square_grid(track, width: float, side: int = SIDE, pixel: float = PIXEL):
    """A window of side x side pixels around what a track touches, on whole pixels."""
    close = stroke_grid(track, width, pixel)
    if max(close.shape) > side:
        raise ValueError(f"a stroke needs {close.shape} pixels: expected at most {side} a side")
    h, w = close.shape
    shift = np.array([(side - w) // 2, (side - h) // 2]) * pixel
    return make_grid((side, side), np.asarray(close.origin) - shift, pixel)


def finer(grid, factor):
    """The same window in pixels `factor` times smaller."""
    shape = tuple(round(n * factor) for n in grid.shape)
    return make_grid(shape, grid.origin, grid.pixel / factor)


roll = jax.jit(rollout)


@functools.partial(jax.jit, static_argnames=("width", "edge", "longest"))
def draw(grid, track, color=(1.0, 1.0, 1.0), width=WIDTH, edge=None, longest=STEPS[-1]):
    """Maps of a track."""
    return trajectory_maps(grid, track, color, width=width, edge=edge, longest=longest)


def between(track, times: int):
    """The track with `times` stamps for each, linear in place and in how deep a tip is pressed."""
    stamps = track.time.shape[0]
    fine = np.arange((stamps - 1) * times + 1) / times
    k = np.minimum(fine.astype(int), stamps - 2)

    def fill(x):
        x = np.asarray(x, np.float64)
        share = (fine - k).reshape(-1, *(1,) * (x.ndim - 1))
        return (1.0 - share) * x[k] + share * x[k + 1]

    force, place = np.asarray(track.force), np.asarray(track.position)
    deep = fill(np.where(force > 0.0, force / TIP_STIFFNESS, -np.abs(place[:, :, 2])))
    place = fill(place)
    place[:, :, 2] = np.maximum(-deep, 0.0)
    found = {"time": fill(track.time), "position": place, "reaction": fill(track.reaction),
             "force": np.maximum(deep, 0.0) * TIP_STIFFNESS}  # fmt: skip
    found = {name: jnp.asarray(x.astype(np.float32)) for name, x in found.items()}
    return dataclasses.replace(track, **found, valid=jnp.asarray(fill(track.valid) > 0.999))


def longest_of(track) -> float:
    """The least of STEPS that the steps of a track's tips fit in."""
    step = np.abs(np.diff(np.asarray(track.position[:, -1, :2]), axis=0)).max(1)
    contact = np.asarray(track.contact[:, -1])
    step = step[contact[1:] | contact[:-1]].max(initial=0.0)
    return next((x for x in STEPS if step <= x), STEPS[-1])
