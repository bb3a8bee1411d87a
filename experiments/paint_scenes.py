"""What show_paint paints: the sheets of the catalogue and a small painting, as lists of strokes."""

import dataclasses

import jax
import numpy as np

from jaxbrush.brush import BrushConfig, BrushParams, make_brush
from jaxbrush.canvas import mix_subtractive
from jaxbrush.paint import RELIEF, PaintParams, for_brush, make_params
from jaxbrush.recordings import BrushEvent, ColorEvent, Session, StrokeEvent
from jaxbrush.stylus import Stroke, make_stroke, resample

PALETTE = {
    "white": (0.92, 0.90, 0.84), "orange": (0.80, 0.16, 0.02), "green": (0.02, 0.25, 0.10),
    "black": (0.02, 0.02, 0.03), "blue": (0.02, 0.06, 0.30), "yellow": (0.85, 0.55, 0.04),
}  # fmt: skip
"""Pigments, linear RGB."""
NAMES = tuple(PALETTE)
BRISTLES = 260
STAMPS = 640
SPEED = 60.0
"""Stamps a stroke is padded to; speed of the hand [mm/s]."""
# shape, width, thickness, length [mm]
BRUSHES = {
    "flat": ("flat", 4.5, 1.4, 18.0), "small flat": ("flat", 2.6, 0.9, 13.0),
    "filbert": ("filbert", 4.5, 1.4, 18.0), "round": ("round", 2.8, 2.8, 15.0),
    "fan": ("fan", 5.0, 0.8, 18.0), "rigger": ("rigger", 1.0, 1.0, 16.0),
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Touch:
    """One stroke: color as shares by name, corners of its path [mm], brush, load, pressure."""

    color: dict[str, float]
    corners: tuple
    brush: str = "flat"
    load: float = 0.8
    pressure: float = 0.45
    fall: float = 0.15


def hand(corners, pressure: float, spacing: float, depth: float, fall: float = 0.15) -> Stroke:
    """A stroke through rounded corners, stamps `spacing` [mm] of the handle's way apart, pressed
    and lifted at its ends.

    Args:
      corners: (n, 2) [mm]. depth: way of the handle at pressure 1 [mm]. fall: share of the stroke
        over which it is lifted.
    """
    return resample(drawn(corners, pressure, fall), STAMPS, spacing, np.inf, depth)


def drawn(corners, pressure: float, fall: float = 0.15) -> Stroke:
    """The stroke of `hand` before it is resampled."""
    corners = np.asarray(corners, float)
    u = np.linspace(0.0, 1.0, 400)
    at = np.linspace(0.0, 1.0, len(corners))
    path = np.stack([np.interp(u, at, corners[:, k]) for k in (0, 1)], 1)
    soft = np.hanning(81) / np.hanning(81).sum()
    path = np.pad(path, ((40, 40), (0, 0)), mode="edge")
    path = np.stack([np.convolve(path[:, k], soft, "valid") for k in (0, 1)], 1)
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    share = way / way[-1]
    press = pressure * np.clip(np.minimum(share / 0.12, (1.0 - share) / fall), 0.0, 1.0)
    heading = np.arctan2(*(path[-1] - path[0])[::-1])
    # The brush leans into the stroke, its broad side across.
    return make_stroke(path, way / SPEED, press, altitude=np.radians(50.0), azimuth=heading,
                       twist=heading - 0.5 * np.pi)  # fmt: skip


def brush_of(name: str, config: BrushConfig) -> tuple[BrushParams, PaintParams, float]:
    """A brush, the paint constants that fit it, and its press depth [mm]."""
    shape, width, thickness, length = BRUSHES[name]
    depth = 0.28 * length
    brush = make_brush(
        jax.random.key(NAMES.index("white") + len(name)), config, shape, BRISTLES, width=width,
        thickness=thickness, length=length, press_depth=depth,
    )  # fmt: skip
    disc = shape in ("round", "rigger")
    return brush, for_brush(make_params(), width, thickness, BRISTLES, disc), depth


def _pressures():
    touches = []
    for k, name in enumerate(("flat", "filbert", "round", "fan")):
        for j, (pressure, load) in enumerate(((0.15, 0.8), (0.4, 0.8), (0.7, 0.8), (0.4, 0.15))):
            start = 3.0 + 17.0 * j
            path = ((start, 4.0 + 7.0 * k), (start + 11.0, 4.0 + 7.0 * k))
            touches.append(Touch({"green": 0.6, "blue": 0.4}, path, name, load, pressure))
    return touches


def _layers():
    return [
        Touch({"green": 1.0}, ((7.0, 3.0), (7.0, 17.0))),
        Touch({"black": 1.0}, ((15.0, 3.0), (15.0, 17.0))),
        Touch({"orange": 1.0}, ((2.5, 10.0), (33.0, 10.0)), load=0.6),
        Touch({"yellow": 1.0}, ((40.0, 5.0), (62.0, 5.0)), pressure=0.55),
        Touch({"blue": 1.0}, ((44.0, 2.5), (48.0, 15.0), (56.0, 15.0), (59.0, 2.5)), "round"),
        Touch({"white": 1.0}, ((40.0, 19.0), (62.0, 19.0)), load=1.0, pressure=0.5),
        Touch({"white": 1.0}, ((62.0, 20.5), (40.0, 18.0)), load=1.0, pressure=0.4),
        Touch({"orange": 0.5, "white": 0.5}, ((4.0, 20.5), (33.0, 20.5)), load=0.12, pressure=0.2),
        Touch({"blue": 0.7, "white": 0.3}, ((3.0, 26.0), (14.0, 23.0), (24.0, 29.0), (34.0, 25.0)),
              "filbert"),
        # A clean brush ploughs through a thick coat.
        Touch({"yellow": 0.6, "white": 0.4}, ((40.0, 26.0), (62.0, 26.0)), load=1.0, pressure=0.35),
        Touch({"yellow": 0.6, "white": 0.4}, ((40.0, 29.0), (62.0, 29.0)), load=1.0, pressure=0.35),
        Touch({"white": 1.0}, ((45.0, 31.0), (57.0, 23.0)), "small flat", load=0.0, pressure=0.6),
    ]  # fmt: skip


def _dry():
    blue, green = {"blue": 0.8, "white": 0.2}, {"green": 0.7, "black": 0.3}
    brushes = ("flat", {"orange": 1.0}), ("filbert", blue), ("round", green)
    hands = (0.3, 0.15), (0.12, 0.2), (0.06, 0.3), (0.04, 0.5)
    touches = []
    for j, (name, color) in enumerate(brushes):
        for k, (load, pressure) in enumerate(hands):
            start, y = 2.5 + 23.0 * j, 4.0 + 7.0 * k
            touches.append(Touch(color, ((start, y), (start + 20.0, y)), name, load, pressure))
    return touches


def _sea():
    """Dusk over the sea: sky, sun, water, a boat, reeds."""
    random = np.random.default_rng(5)
    touches = []

    def sweep(y, start, end, color, brush="flat", bend=0.6, **how):
        middle = 0.5 * (start + end)
        path = ((start, y + random.uniform(-0.4, 0.4)), (middle, y + random.uniform(-bend, bend)),
                (end, y + random.uniform(-0.4, 0.4)))  # fmt: skip
        touches.append(Touch(color, path, brush, **how))

    sky = (
        {"blue": 0.75, "white": 0.25}, {"blue": 0.5, "white": 0.5},
        {"blue": 0.22, "white": 0.68, "orange": 0.1},
        {"white": 0.6, "orange": 0.25, "yellow": 0.15},
        {"yellow": 0.5, "orange": 0.25, "white": 0.25},
    )  # fmt: skip
    for k, color in enumerate(sky):
        y = 2.2 + 3.4 * k
        cut = 21.0 + random.uniform(-4.0, 4.0)
        sweep(y, 1.0, cut + 2.0, color, load=0.75, pressure=0.4)
        sweep(y, 43.0, cut - 1.0, color, load=0.75, pressure=0.4)
    water = (
        {"blue": 0.45, "green": 0.25, "white": 0.2, "orange": 0.1},
        {"blue": 0.6, "green": 0.3, "white": 0.1}, {"blue": 0.7, "green": 0.25, "black": 0.05},
        {"blue": 0.6, "green": 0.2, "black": 0.2},
    )  # fmt: skip
    for k, color in enumerate(water):
        y = 19.2 + 3.1 * k
        cut = 22.0 + random.uniform(-5.0, 5.0)
        sweep(y, 43.0, cut - 1.0, color, load=0.7, pressure=0.42)
        sweep(y, 1.0, cut + 2.0, color, load=0.7, pressure=0.42)
    sun = {"yellow": 0.45, "white": 0.55}
    ring = ((30.0, 13.4), (31.4, 12.4), (32.6, 13.4), (31.3, 14.4), (30.2, 13.5))
    touches.append(Touch(sun, ring, "round", load=1.0, pressure=0.35))
    for k in range(5):
        half = 2.4 - 0.25 * k + random.uniform(-0.4, 0.6)
        x = 31.2 + random.uniform(-0.6, 0.6)
        sweep(18.6 + 1.9 * k, x - half, x + half, {"yellow": 0.4, "orange": 0.35, "white": 0.25},
              "small flat", bend=0.2, load=0.6, pressure=0.22)  # fmt: skip
    sail = {"white": 0.95, "orange": 0.05}
    touches.append(Touch(sail, ((14.2, 10.0), (15.4, 14.0), (16.0, 17.6)), "small flat", 1.0, 0.4))
    touches.append(Touch(sail, ((13.4, 11.5), (12.0, 15.5), (11.4, 17.4)), "small flat", 1.0, 0.35))
    touches.append(Touch({"black": 0.7, "orange": 0.3}, ((10.0, 18.9), (14.0, 19.6), (18.4, 18.7)),
                         "small flat", 0.9, 0.45))  # fmt: skip
    for k in range(7):
        x = 36.0 + 1.1 * k + random.uniform(-0.3, 0.3)
        lean = random.uniform(-2.0, 1.0)
        path = ((x, 31.0), (x + 0.3 * lean, 26.0), (x + lean, 21.0 + random.uniform(-1.5, 2.0)))
        dark = {"black": 0.55, "green": 0.45} if k % 2 else {"green": 0.6, "yellow": 0.4}
        touches.append(Touch(dark, path, "rigger", 0.9, 0.4, fall=0.4))
    return touches


SCENES = {
    "strokes": ((256, 576), _pressures), "layers": ((256, 528), _layers), "dry": ((256, 576), _dry),
    "sea": ((264, 352), _sea),
}  # fmt: skip
"""Size [pixels] and strokes of each sheet."""


def relief_of(scene: str) -> float:
    """Depth of a sheet's weave [mm]: coarser than usual where dry brushes are to catch on it."""
    return 0.09 if scene == "dry" else RELIEF


# shape, width, thickness, length, press depth [mm]: brushes such as the networks learned from
_RECORDED = {
    "flat": ("flat", 3.8, 1.14, 17.4, 4.35), "small flat": ("flat", 2.4, 0.75, 13.2, 3.3),
    "filbert": ("filbert", 3.8, 1.14, 17.4, 4.35),
    "round": ("round", 2.2, 2.2, 12.6, 3.15), "rigger": ("round", 1.4, 1.4, 10.2, 2.55),
}  # fmt: skip
_FIELDS = ("shape", "width", "thickness", "length", "depth")
RATE = 125.0
"""Samples a second of a recorded pen."""


def recorded(scene: str = "sea") -> Session:
    """A scene as a session that a painter might have recorded: brushes, colors, pen samples.

    The brush is dipped before every stroke, as full as the scene says.
    """
    shape, touches = SCENES[scene]
    events, seen = [], None
    for touch in touches():
        brush = dict(zip(_FIELDS, _RECORDED[touch.brush], strict=True)) | {"load": touch.load}
        if brush != seen:
            events.append(BrushEvent(brush))
            seen = brush
        share = np.asarray([touch.color.get(name, 0.0) for name in NAMES], np.float32)
        rgb = mix_subtractive(share, np.asarray(list(PALETTE.values()), np.float32))
        events.append(ColorEvent(tuple(round(float(c), 4) for c in rgb)))
        pen = drawn(touch.corners, touch.pressure, touch.fall)
        t = np.arange(0.0, float(pen.time[-1]) + 1.0 / RATE, 1.0 / RATE)
        at = lambda x, t=t, pen=pen: tuple(  # noqa: E731
            np.interp(t, np.asarray(pen.time), np.asarray(x, float)).round(4).tolist()
        )
        events.append(
            StrokeEvent(
                t=tuple(t.round(4).tolist()), x=at(pen.position[:, 0]), y=at(pen.position[:, 1]),
                pressure=at(pen.pressure), altitude=at(pen.altitude), azimuth=at(pen.azimuth),
                twist=at(pen.twist),
            )
        )  # fmt: skip
    return Session((shape[1] * 0.125, shape[0] * 0.125), 1.0, tuple(events))
