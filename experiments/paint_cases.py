"""The stroke that paint settings are compared on, and what of its result is measured.

A flat brush crosses a wet band of another color. The bristles' track is made once, with stamps
closer than any setting's, and thinned out, so that every setting sees the same hair.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush import metrics
from jaxbrush.brush import BrushConfig, make_brush, rollout
from jaxbrush.brush.rollout import BristleTrack
from jaxbrush.canvas import flatten
from jaxbrush.paint import (
    PaintConfig,
    empty_canvas,
    heightfield_stroke,
    load_brush,
    paint_stroke,
    presets,
)
from jaxbrush.stylus import make_stroke, resample

FINE = 1.0 / 64.0  # [mm] between stamps of the track
GRID = 0.125  # [mm], pixels on which results are compared
HEIGHT, WIDTH = 8.0, 18.0  # [mm] of the canvas
BAND, DEEP = (5.0, 8.0), 0.25  # [mm] where along x another color lies, and how thick
START, SPEED = 3.5, 60.0  # [mm], [mm/s]
STEADY = (8.25, 11.25)  # [mm], where along x the stroke is even
BRISTLES = 260
PALETTE = np.array([(0.80, 0.16, 0.02), (0.02, 0.25, 0.10)])
"""Linear RGB of the brush's pigment and the band's."""

paint = jax.jit(paint_stroke)
films = jax.jit(heightfield_stroke)


@dataclasses.dataclass(frozen=True)
class Setting:
    """A point of the chart: a name, its family and tag there, and what it changes."""

    name: str
    family: str
    tag: str
    config: PaintConfig
    spacing: float
    bristles: int = BRISTLES


@functools.cache
def track_of(length: float) -> BristleTrack:
    """The bristles' way along a straight stroke [mm], stamps FINE apart, pressed and lifted."""
    u = np.linspace(0.0, 1.0, 400)
    path = np.stack([START + length * u, np.full_like(u, 0.5 * HEIGHT)], 1)
    press = 0.5 * np.clip(np.minimum(u / 0.12, (1.0 - u) / 0.15), 0.0, 1.0)
    stroke = make_stroke(path, length * u / SPEED, press, altitude=np.radians(50.0), azimuth=0.0)
    count = int(np.ceil((length + 5.0) / FINE)) + 2
    stroke = resample(stroke, count, FINE, np.inf, depth=5.0)
    brush = make_brush(jax.random.key(0), BrushConfig(), "flat", BRISTLES, width=4.5, thickness=1.4)
    track = jax.block_until_ready(jax.jit(rollout)(BrushConfig(), brush, stroke))
    last = int(np.asarray(track.valid).sum())
    return jax.tree.map(lambda a: np.asarray(a)[:last], track)


def thinned(track: BristleTrack, spacing: float, bristles: int = BRISTLES) -> BristleTrack:
    """Every so many stamps of a track, its end among them, and some of its bristles."""
    every = round(spacing / FINE)
    stamps = np.arange(0, track.time.shape[0], every)
    if stamps[-1] != track.time.shape[0] - 1:
        stamps = np.append(stamps, track.time.shape[0] - 1)
    some = np.linspace(0, track.position.shape[-1] - 1, bristles).astype(int)
    short = {f.name: jnp.asarray(getattr(track, f.name)[stamps]) for f in dataclasses.fields(track)}
    for name in ("position", "force"):
        short[name] = short[name][..., some]
    return BristleTrack(**short)


def canvas_of(config: PaintConfig, band=BAND):
    """The canvas before the stroke, (z, k, y, x), wet DEEP between two x [mm]."""
    shape = round(HEIGHT / config.pixel), round(WIDTH / config.pixel)
    canvas = empty_canvas(config, shape)
    level = np.arange(config.layers)
    fill = np.clip(DEEP / config.layer - level, 0.0, 1.0)
    a, b = (round(x / config.pixel) for x in band)
    return canvas.at[:, 1, :, a:b].set(jnp.asarray(fill, float)[:, None, None])


def on_grid(x, pixel: float):
    """A field (y, x, ...) on pixels of GRID: means of finer ones, linear between coarser ones."""
    x = np.asarray(x, np.float64)
    n = round(max(GRID / pixel, pixel / GRID))
    if n == 1:
        return x
    if pixel < GRID:
        return x.reshape(x.shape[0] // n, n, x.shape[1] // n, n, *x.shape[2:]).mean((1, 3))
    for axis in (0, 1):
        at = np.clip((np.arange(n * x.shape[axis]) + 0.5) / n - 0.5, 0.0, x.shape[axis] - 1.0)
        low = np.minimum(at.astype(int), x.shape[axis] - 2)
        share = (at - low).reshape([-1 if k == axis else 1 for k in range(x.ndim)])
        x = np.take(x, low, axis) * (1.0 - share) + np.take(x, low + 1, axis) * share
    return x


@dataclasses.dataclass(frozen=True)
class Result:
    """What a stroke left. amounts: (k, y, x) thickness of each pigment [mm]; color: (y, x, 3) of
    what is seen, both on pixels of GRID. laid: what the brush gave [mm^3]. drift: relative change
    of all paint. fullest: fill of a cell below the top. residual: means over the stroke of the
    viscous solves and of the pressure."""

    amounts: np.ndarray
    color: np.ndarray
    laid: float
    drift: float
    fullest: float
    residual: tuple[float, float]
    stamps: int

    @property
    def height(self):
        return self.amounts.sum(0)


def padded(track: BristleTrack, stamps: int) -> BristleTrack:
    """A track with stamps that do not count at its end, `stamps` in all."""
    more = stamps - track.time.shape[0]
    track = jax.tree.map(lambda a: jnp.concatenate([a, jnp.repeat(a[-1:], more, axis=0)]), track)
    return dataclasses.replace(track, valid=track.valid & (np.arange(stamps) < stamps - more))


def lay(setting: Setting, length: float, stamps: int = 0):
    """Paints the stroke, padded to so many stamps: (Result, a call that paints it again)."""
    config, params = setting.config, presets.params_of(setting.bristles)
    track = thinned(track_of(length), setting.spacing, setting.bristles)
    track = padded(track, max(stamps, track.time.shape[0]))
    canvas = canvas_of(config)
    brush = load_brush(config, params, setting.bristles, 0.8, jnp.asarray([1.0, 0.0]))
    stroke = films if config.layers == 2 else paint
    call = lambda: stroke(config, params, canvas, brush, track)  # noqa: E731
    after, left, report = jax.block_until_ready(call())
    held = lambda b: float(np.sum(np.asarray(b.tip + b.reservoir, np.float64)))  # noqa: E731
    on = lambda c: float(np.sum(np.asarray(c, np.float64))) * config.cell  # noqa: E731
    before, now = on(canvas) + held(brush), on(after) + held(left)
    seen = flatten(after, config.layer, jnp.asarray(PALETTE, float))
    amounts = config.layer * np.moveaxis(np.asarray(jnp.sum(after, axis=0)), 0, -1)
    left_over = np.asarray(report.residual)
    busy = left_over[:, 3] > 0.0
    return Result(
        amounts=np.moveaxis(on_grid(amounts, config.pixel), -1, 0),
        color=on_grid(seen.color, config.pixel),
        laid=held(brush) - held(left),
        drift=(now - before) / before,
        fullest=float(report.fullest.max()),
        residual=(float(left_over[busy, :3].mean()), float(left_over[busy, 3].mean())),
        stamps=int(np.asarray(track.valid).sum()),
    ), call


def touched(true: Result, least: float = 2e-3):
    """Where the stroke changed the canvas by more than `least` [mm], (y, x) bool."""
    config = PaintConfig(pigments=2)
    before = config.layer * np.asarray(jnp.sum(canvas_of(config), axis=0))
    return np.abs(true.amounts - before).max(0) > least


def errors(found: Result, true: Result) -> tuple[float, float]:
    """Height, rms [um], and color, mean CIEDE2000, where the true stroke changed the canvas."""
    mask = touched(true)
    height = 1e3 * np.sqrt(np.mean((found.height - true.height)[mask] ** 2))
    color = metrics.delta_e(jnp.asarray(found.color, float), jnp.asarray(true.color, float))
    return float(height), float(np.asarray(color)[mask].mean())


def beads(found: Result, period: float) -> tuple[float, float]:
    """The spectrum along the stroke at the stamps' period, behind the band.

    Returns:
      (amplitude of that line over its surroundings, 1 where it is nothing special; its height from
      crest to trough, rms over the rows [um]).
    """
    start, count = (round(x / GRID) for x in (STEADY[0], STEADY[1] - STEADY[0]))
    rows, at = found.height[:, start : start + count], np.arange(count)
    rows = rows[rows.min(1) > 0.03]
    trend = np.polynomial.polynomial.polyfit(at, rows.T, 2)
    window = np.hanning(count + 1)[:-1]
    rows = (rows - np.polynomial.polynomial.polyval(at, trend)) * window
    frequency = np.linspace(0.0, 0.5 / GRID, 16 * count + 1)
    wave = np.exp(-2j * np.pi * np.outer(at * GRID, frequency))
    power = np.mean(np.abs(rows @ wave) ** 2, axis=0)
    away = np.abs(frequency - 1.0 / period) * count * GRID
    line, around = power[away < 0.5].mean(), power[(away > 1.5) & (away < 3.5)].mean()
    return float(np.sqrt(line / around)), float(4e3 * np.sqrt(line) / window.sum())
