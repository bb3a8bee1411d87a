"""A stroke under the pen: its samples so far, and the brush moved along them piece by piece."""

import dataclasses

import jax
import numpy as np

from jaxbrush.brush import BrushParams, advance, begin
from jaxbrush.loaded import LOAD, loaded
from jaxbrush.painter import PainterConfig
from jaxbrush.stages import on_steps, touches
from jaxbrush.stylus import Stroke, make_stroke

PIECE = 32
"""Stamps that the preview moves the brush at once; a multiple of every stride in use."""
FIELDS = ("time", "x", "y", "pressure", "altitude", "azimuth", "twist")
_UPRIGHT = {"altitude": 0.5 * np.pi, "azimuth": 0.0, "twist": 0.0}


def _piece(options: PainterConfig, brush, load, motion, stroke, way):
    track, motion = advance(options.brush, brush, motion, stroke)
    track = on_steps(
        options, dataclasses.replace(loaded(track, brush, load, options.relief), time=way)
    )
    return track, touches(options, track), motion


_advance = jax.jit(_piece)
_begin = jax.jit(begin, static_argnums=0)


class Pen:
    """The stroke under the pen: its samples, and how far the preview has moved the brush."""

    def __init__(self, options: PainterConfig, brush: BrushParams, load: float = LOAD):
        self.options, self.brush, self.load = options, brush, np.float32(load)
        self.depth = float(brush.press_depth)
        self.samples = {name: np.zeros(0) for name in FIELDS}
        self.way = np.zeros(0)
        self.motion, self.done, self.tip = None, 0, None

    def add(self, new: dict):
        """Takes samples, and measures the way to each in stamps, as `stylus.resample` does."""
        joined = {n: np.concatenate([self.samples[n], new[n]]) for n in FIELDS}
        for name in ("azimuth", "twist"):
            joined[name] = np.unwrap(joined[name])
        d = [np.diff(joined[n]) for n in ("x", "y", "pressure")]
        steps = np.sqrt(d[0] ** 2 + d[1] ** 2 + (self.depth * d[2]) ** 2) / self.options.pixel
        self.samples, self.way = joined, np.concatenate([[0.0], np.cumsum(steps)])

    def _stamps(self, first: int):
        """PIECE + 1 stamps from number `first` on, and their ways [mm]; those past the pen repeat
        its place."""
        number = first + np.arange(PIECE + 1)
        at = np.minimum(number, self.way[-1])
        now = {n: np.interp(at, self.way, self.samples[n]).astype(np.float32) for n in FIELDS}
        stroke = Stroke(
            time=now["time"] - np.float32(self.samples["time"][0]),
            position=np.stack([now["x"], now["y"]], 1),
            pressure=now["pressure"],
            altitude=now["altitude"],
            azimuth=now["azimuth"],
            twist=now["twist"],
            valid=number < np.ceil(self.way[-1]) + 1,
        )
        return stroke, (at * self.options.pixel).astype(np.float32)

    def advance(self):
        """(track, touches, final) of each piece that is new or has grown; tracks by the clock of
        the way, as `stages.trace`. A piece repeats the last stamp of the one before."""
        config = self.options.brush
        if self.motion is None:
            self.motion = _begin(config, self.brush, self._stamps(0)[0])
        while True:
            piece, way = self._stamps(self.done)
            track, bounds, motion = _advance(
                self.options, self.brush, self.load, self.motion, piece, way
            )
            # Only once the pen is past it, a piece is what it will stay.
            final = self.way[-1] >= self.done + PIECE
            self.tip = track, bounds
            yield track, bounds, final
            if not final:
                return
            self.motion, self.done = motion, self.done + PIECE

    def stroke(self) -> Stroke:
        s = self.samples
        return make_stroke(
            np.stack([s["x"], s["y"]], 1).astype(np.float32),
            (s["time"] - s["time"][0]).astype(np.float32),
            *(s[n].astype(np.float32) for n in FIELDS[3:]),
        )


def checked(pen: Pen, given: dict) -> dict:
    count = np.size(given["x"])
    out = {}
    for name in FIELDS:
        value = _UPRIGHT[name] if given[name] is None else given[name]
        value = np.asarray(value, float)
        if value.size not in (1, count) or value.ndim > 1 or not np.all(np.isfinite(value)):
            raise ValueError(f"{name} = {given[name]!r}: expected {count} finite numbers")
        out[name] = np.broadcast_to(value, (count,))
    if count and not (0.0 <= out["pressure"].min() and out["pressure"].max() <= 1.0):
        raise ValueError(f"pressure = {given['pressure']!r}: expected numbers within [0, 1]")
    times = np.concatenate([pen.samples["time"][-1:], out["time"]])
    if np.any(np.diff(times) < 0.0):
        raise ValueError(f"time = {given['time']!r}: expected no step back")
    return out
