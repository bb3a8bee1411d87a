"""The engines that paint a session: the simulator as truth, its fastest setting, the networks.

An engine is made once and paints deed by deed: `paint(deed) -> {stage: seconds}`, `canvas() ->
Canvas`. A deed is one stroke with its brush, freshly loaded, and its color.
"""

import dataclasses
import functools
import time
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import nnls

from jaxbrush import data, painter
from jaxbrush.brush import BrushConfig, BrushParams, make_brush, rollout
from jaxbrush.canvas import Canvas, absorbed, blank, flatten, reflected
from jaxbrush.loaded import LOAD
from jaxbrush.paint import (
    RELIEF,
    PaintConfig,
    PaintParams,
    empty_canvas,
    for_brush,
    load_brush,
    make_params,
    paint_stroke,
    presets,
    weave,
)
from jaxbrush.raster.grid import bucket
from jaxbrush.recordings import BrushEvent, ColorEvent, Session, StrokeEvent, to_stroke
from jaxbrush.session import Session as Live
from jaxbrush.stylus import Stroke, resample, stamps_needed

BRUSH = {
    "shape": "flat", "width": 3.0, "thickness": 0.9, "length": 15.0, "depth": 3.75, "load": LOAD,
    "bristles": 128, "seed": 0,
}  # fmt: skip
"""The brush of a session that names none; what a brush event may say. width, thickness, length of
the ferrule and hair, depth at full pressure [mm]."""
COLORS = ((0.02, 0.06, 0.30), (0.80, 0.16, 0.02), (0.85, 0.55, 0.04), (0.02, 0.25, 0.10))
"""Taken in turn by strokes of a session that names no color, linear RGB."""
PIXEL = PaintConfig().pixel


@dataclasses.dataclass(frozen=True)
class Deed:
    """One stroke to paint. stroke: raw samples [mm]. color: linear RGB of the load. load: share of
    what the brush holds."""

    stroke: Stroke
    brush: BrushParams
    paint: PaintParams
    color: tuple[float, float, float]
    load: float
    bristles: int


def brush_of(event: BrushEvent) -> tuple[BrushParams, PaintParams, dict]:
    """What a brush event names.

    Raises:
      ValueError: a field that no brush has, or a shape that is none.
    """
    unknown = sorted(set(event.params) - set(BRUSH))
    if unknown:
        raise ValueError(f"brush event: {', '.join(unknown)}: expected fields among {list(BRUSH)}")
    say = BRUSH | event.params
    return *_made(*(say[name] for name in BRUSH if name != "load")), say


@functools.lru_cache(maxsize=64)
def _made(shape, width, thickness, length, depth, bristles, seed):
    brush = make_brush(
        jax.random.key(int(seed)), BrushConfig(), shape, int(bristles), width=width,
        thickness=thickness, length=length, press_depth=depth,
    )  # fmt: skip
    disc = shape in ("round", "rigger")
    return brush, for_brush(make_params(), width, thickness, int(bristles), disc)


def deeds_of(session: Session, shape) -> list[Deed]:
    """The strokes of a session, scaled to fill a canvas of `shape` (h, w) pixels where the
    session's own canvas has other sides."""
    side = np.asarray(session.canvas)
    factor = float(np.min(np.asarray(shape)[::-1] * PIXEL / side))
    session = dataclasses.replace(session, scale=factor * session.scale)
    found, brush, color = [], brush_of(BrushEvent({})), None
    for event in session.events:
        if isinstance(event, BrushEvent):
            brush = brush_of(event)
        elif isinstance(event, ColorEvent):
            color = tuple(event.rgb)
        elif isinstance(event, StrokeEvent):
            stroke = to_stroke(session, event)
            own = COLORS[len(found) % len(COLORS)] if color is None else color
            params, paint, say = brush
            found.append(Deed(stroke, params, paint, own, say["load"], int(say["bristles"])))
    return found


def _absorbed(rgb) -> np.ndarray:
    return np.asarray(absorbed(jnp.asarray(rgb, float)), float)


def shares(rgb, palette) -> np.ndarray:
    """Shares of pigments (k, 3) whose subtractive mixture comes nearest to a color."""
    # A heavy last row makes the shares sum to 1.
    left = np.vstack([_absorbed(palette).T, np.full(len(palette), 1e3)])
    found, _ = nnls(left, np.append(_absorbed(rgb), 1e3))
    return found / found.sum()


def palette_of(deeds, most: int = 6) -> np.ndarray:
    """Pigments that the colors of all deeds can be mixed from, (k, 3): the colors farthest from
    each other, by absorption."""
    colors = np.unique(np.asarray([d.color for d in deeds]), axis=0)
    place = _absorbed(colors)
    chosen = [int(np.argmax(np.linalg.norm(place - place.mean(0), axis=1)))]
    while len(chosen) < min(most, len(colors)):
        away = np.min(np.linalg.norm(place[:, None] - place[None, chosen], axis=-1), axis=1)
        chosen.append(int(np.argmax(away)))
    return colors[chosen]


def mixable(deeds) -> list[Deed]:
    """The deeds in colors that the palette of all of them mixes, the nearest to their own: else the
    simulator paints in other colors than the networks (the sea's farthest by a ΔE of 9.9)."""
    palette = palette_of(deeds)

    def mixed(rgb):
        mean = shares(rgb, palette) @ _absorbed(palette)
        return tuple(float(x) for x in reflected(jnp.asarray(mean)))

    return [dataclasses.replace(deed, color=mixed(deed.color)) for deed in deeds]


def _clock(stages: dict, name: str, call):
    start = time.perf_counter()
    out = jax.block_until_ready(call())
    stages[name] = time.perf_counter() - start
    return out


_needed = jax.jit(stamps_needed)


def _moved(brush, stroke, spacing, stamps):
    stroke = resample(stroke, stamps, spacing, np.inf, brush.press_depth)
    return rollout(BrushConfig(), brush, stroke)


class Simulator:
    """The paint simulator as an engine."""

    def __init__(
        self, config: PaintConfig, spacing: float, shape, palette, bristles: int | None,
        relief: float = RELIEF,
    ):  # fmt: skip
        self.config = dataclasses.replace(config, pigments=len(palette))
        self.spacing, self.shape, self.palette = spacing, tuple(shape), jnp.asarray(palette)
        self.bristles = bristles
        # Strokes over the edge of what is kept must not pile up there.
        self.margin = round(4.0 / config.pixel)
        factor = config.pixel / PIXEL
        inner = [int(np.ceil(n / factor)) for n in shape]
        self.inside = tuple(slice(self.margin, self.margin + n) for n in inner)
        size = tuple(n + 2 * self.margin for n in inner)
        self.paint_canvas = empty_canvas(self.config, size)
        self.tooth = weave(size, config.pixel, relief)
        self._move, self._lay = jax.jit(_moved, static_argnums=3), jax.jit(paint_stroke)

    def paint(self, deed: Deed) -> dict[str, float]:
        """Paints a stroke; seconds of each stage."""
        stages = {}
        brush, paint, count = deed.brush, deed.paint, deed.bristles
        if self.bristles is not None and self.bristles < count:
            brush, paint, count = fewer(deed, self.bristles)
        edge = self.margin * self.config.pixel
        stroke = painter.padded(deed.stroke)
        stroke = dataclasses.replace(stroke, position=stroke.position + np.float32(edge))
        stamps = bucket(max(2, int(_needed(stroke, self.spacing, np.inf, brush.press_depth))))
        track = _clock(stages, "brush", lambda: self._move(
            brush, stroke, self.spacing, stamps
        ))  # fmt: skip
        loaded = load_brush(
            self.config, paint, count, deed.load, shares(deed.color, np.asarray(self.palette))
        )
        self.paint_canvas, _, _ = _clock(stages, "paint", lambda: self._lay(
            self.config, paint, self.paint_canvas, loaded, track, self.tooth
        ))  # fmt: skip
        return stages

    def canvas(self) -> Canvas:
        """What is seen, on the pixels of the session."""
        rows, columns = self.inside
        seen = flatten(
            self.paint_canvas[:, :, rows, columns], self.config.layer, self.palette,
            make_params().opacity, mixing="subtractive",
        )  # fmt: skip
        if self.config.pixel == PIXEL:
            return seen
        size = (self.shape[1], self.shape[0])
        large = lambda x: cv2.resize(np.asarray(x), size, interpolation=cv2.INTER_CUBIC)  # noqa: E731
        return Canvas(
            height=jnp.maximum(large(seen.height), 0.0), color=jnp.clip(large(seen.color), 0.0, 1.0)
        )


def fewer(deed: Deed, count: int) -> tuple[BrushParams, PaintParams, int]:
    """The brush of a deed with every n-th bristle only, which stand for as many more hairs."""
    keep = np.linspace(0, deed.bristles - 1, count).round().astype(int)
    take = lambda x: x[..., keep] if x.ndim and x.shape[-1] == deed.bristles else x  # noqa: E731
    paint = dataclasses.replace(deed.paint, hairs=deed.paint.hairs * deed.bristles / count)
    return jax.tree.map(take, deed.brush), paint, count


class Neural:
    """The networks as an engine."""

    def __init__(self, options: painter.PainterConfig, nets: painter.Nets, shape):
        self.options, self.nets = options, nets
        self._canvas = blank(shape)

    def paint(self, deed: Deed) -> dict[str, float]:
        """Paints a stroke; seconds of each stage."""
        stages, last = {}, [time.perf_counter()]

        def watch(stage, value):
            jax.block_until_ready(value)
            now = time.perf_counter()
            stages[stage], last[0] = now - last[0], now

        self._canvas = painter.paint_stroke(
            self.options, self.nets, self._canvas, deed.brush, np.asarray(deed.color, np.float32),
            deed.stroke, donate=True, watch=watch, load=deed.load,
        )  # fmt: skip
        return stages

    def canvas(self) -> Canvas:
        return jax.tree.map(jnp.copy, self._canvas)


FRAME = 1.0 / 60.0
"""Of a screen [s]."""
PAUSE = 0.2
"""Between strokes [s]: the median of the recorded painting that ships with libmypaint is 0.22 s."""


def preview_times(options: painter.PainterConfig, nets: painter.Nets, shape, deeds):
    """Draws a session as a hand would, the networks at work, twice: the first time compiles.

    Returns:
      Seconds from the last sample of each frame of 1/60 s to its preview, and from each pen-up to
      the finished stroke, noticed at the next frame.
    """
    took, ended, late = [], {}, {}

    def poll(session):
        for patch in session.poll():
            late.setdefault(patch.stroke, time.perf_counter() - ended[patch.stroke])

    with Live(options, nets, blank(shape)) as session:
        for warm in (False, True):
            took.clear(), late.clear()
            for deed in deeds:
                session.begin(deed.brush, deed.color, load=deed.load)
                pen = jax.tree.map(np.asarray, deed.stroke)
                frame = np.floor((pen.time - pen.time[0]) / FRAME).astype(int)
                for number in np.unique(frame):
                    at = frame == number
                    start = time.perf_counter()
                    session.add(
                        pen.time[at], *pen.position[at].T, pen.pressure[at], pen.altitude[at],
                        pen.azimuth[at], pen.twist[at],
                    )  # fmt: skip
                    took.append(time.perf_counter() - start)
                    poll(session)
                    if warm:
                        # The next samples are not there yet.
                        time.sleep(max(0.0, start + FRAME - time.perf_counter()))
                ended[session.end()] = up = time.perf_counter()
                while warm and time.perf_counter() < up + PAUSE:
                    time.sleep(FRAME)
                    poll(session)
            session.wait()
            poll(session)
    return np.asarray(took), np.asarray(list(late.values()))


SHIPPED = (Path("checkpoints/height.npz"), Path("checkpoints/color.npz"))
FAST = (Path("checkpoints/fast_height.npz"), Path("checkpoints/fast_color.npz"))
"""Networks of half the width of `SHIPPED`."""
TAUGHT = data.PRESETS["cpu"].pairs
"""The simulator as the networks were taught by it."""


def make(name: str, shape, deeds: list[Deed], weights=SHIPPED, relief: float = RELIEF):
    """An engine by name, "neural", "realtime" or "offline", for a canvas with a weave `relief` [mm]
    deep.

    Raises:
      ValueError, OSError: weights that are not there, or none; a relief below 0.
    """
    if not 0.0 <= relief < np.inf:
        raise ValueError(f"relief = {relief}: expected >= 0 mm")
    if name == "neural":
        return Neural(painter.PainterConfig(relief=relief), painter.load_nets(*weights), shape)
    if name == "offline":
        return Simulator(TAUGHT.paint, TAUGHT.spacing, shape, palette_of(deeds), None, relief)
    config, _, spacing = presets.realtime()
    return Simulator(config, spacing, shape, palette_of(deeds), presets.REAL // 2, relief)
