"""Training pairs from the simulator: a canvas before and after one more stroke (paper 4.2).

A canvas is painted stroke by stroke, and every stroke gives a pair: what lay there, the maps of
the stroke, and what the simulator made of it. Pair i is stroke i % strokes on canvas
i // strokes, so it depends on (config, seed, i) only.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.brush import BrushConfig, BrushParams, make_brush, rollout
from jaxbrush.canvas import flatten, from_srgb, to_srgb
from jaxbrush.loaded import REACH, drawn_maps, loaded, on_way
from jaxbrush.paint import (
    RELIEF,
    BrushPaint,
    PaintConfig,
    PaintParams,
    empty_canvas,
    for_brush,
    load_brush,
    make_params,
    paint_stroke,
    weave,
)
from jaxbrush.raster import make_grid
from jaxbrush.raster.grid import dilate
from jaxbrush.structs import config, state
from jaxbrush.stylus import Stroke, random_stroke, resample, transform

SHAPES = ("flat", "filbert", "round")
MARGIN = 32
"""Pixels of canvas around what is kept, so that a stroke over its edge piles nothing up there."""
DRY, DRY_BESIDE = 0.15, 0.35
"""Share of strokes with a brush that holds next to nothing, and of those painted side by side: with
one share for all, not one stroke in 25 was dry and pulled, as those are that show single hairs."""
PULLED = 0.75
"""Share of the canvases painted side by side whose strokes are pulled: the handle leans the way it
goes, under a steady pressure. Hair then lies flat and keeps its place, and grooves last all along;
a hand that leans one way whatever the stroke does, as that of `random_stroke`, hardly ever does it.
Networks that saw it alone knew the finest grooves of such strokes (all of the sea's) to a
correlation of 0.46, where the map of the hair has -0.76."""


@config
class PairConfig:
    """size: of the canvas, square [pixels]. strokes: painted on each canvas, one pair each.
    beside: every so many-th canvas is painted side by side (`draw_beside`), 0 is none. stamps: of
    a stroke at most; longer ones are made smaller. way: of strokes that are not side by side, at
    most, also so [mm]. spacing: of the stamps that are painted [mm], a pixel or a whole part of
    it; maps are drawn a pixel apart, as in use. bristles: simulated. relief: of every other canvas
    at most, others have the usual one [mm]. paint, brush: the simulators."""

    size: int = 128
    strokes: int = 4
    beside: int = 3
    stamps: int = 448
    way: float = 19.0
    spacing: float = 0.0625
    bristles: int = 128
    relief: float = 0.1
    paint: PaintConfig = PaintConfig(window=48, solver="chebyshev")  # noqa: RUF009
    brush: BrushConfig = BrushConfig()  # noqa: RUF009

    def __post_init__(self):
        for name, least in (("strokes", 1), ("beside", 0), ("stamps", 8), ("bristles", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"PairConfig.{name} = {getattr(self, name)}: expected >= {least}")
        if not self.spacing > 0.0 or abs(self.every * self.spacing - self.paint.pixel) > 1e-9:
            raise ValueError(
                f"PairConfig.spacing = {self.spacing}: expected the pixel, {self.paint.pixel} mm, "
                "or a whole part of it"
            )
        if not self.relief >= RELIEF:
            raise ValueError(f"PairConfig.relief = {self.relief}: expected >= {RELIEF} mm")
        if not self.way > 0.0:
            raise ValueError(f"PairConfig.way = {self.way}: expected > 0 mm")
        if self.size < self.paint.window or self.size % 4:
            raise ValueError(
                f"PairConfig.size = {self.size}: expected a multiple of 4, at least the window, "
                f"{self.paint.window}"
            )

    @property
    def every(self) -> int:
        """Stamps a pixel."""
        return max(1, round(self.paint.pixel / self.spacing))


@state
class Plan:
    """One stroke, drawn at random. mix: (k,) shares of the pigments on the brush. load: ()."""

    stroke: Stroke
    brush: BrushParams
    paint: PaintParams
    mix: jax.Array
    load: jax.Array


@state
class Picture:
    """What a pair stores of a canvas and a stroke; colors in sRGB, [0, 1].

    height: (h, w) before, new_height: after [mm]. color, new_color: (h, w, 3). pressure, sweeps,
    time, load: (h, w) and trajectory: (h, w, 3) maps of the stroke; sweeps and load of a `Loaded`
    track, time by the clock of `on_way` [mm]. tip: (h, w) height of the latest bristle's tip [mm],
    up to `COAT`. film: (h, w) height after, if hair alone moved paint, hair: (h, w) what was
    in it last (`laid_film`) [mm]. picked: (h, w, 3), lift: (h, w) what bristles had picked up
    (`picked_up`). mask: (h, w) 1 where it may have changed something. reached: () whether the
    brush stayed inside the simulated window.
    """

    height: jax.Array
    color: jax.Array
    pressure: jax.Array
    sweeps: jax.Array
    trajectory: jax.Array
    time: jax.Array
    load: jax.Array
    tip: jax.Array
    film: jax.Array
    hair: jax.Array
    picked: jax.Array
    lift: jax.Array
    new_height: jax.Array
    new_color: jax.Array
    mask: jax.Array
    reached: jax.Array


@functools.partial(jax.jit, static_argnums=1)
def draw_palette(key, pigments: int):
    """(k, 3) linear RGB as a painter squeezes them out: whites, earths, a few strong colors."""
    hue, chroma, value = jax.random.uniform(key, (3, pigments))
    # From HSV; saturation falls off for the lightest.
    value = 0.08 + 0.87 * value
    chroma = 0.95 * chroma * (1.0 - 0.5 * value**3)
    wheel = jnp.abs(jnp.mod(6.0 * hue[:, None] + jnp.array([[0.0, 4.0, 2.0]]), 6.0) - 3.0) - 1.0
    return from_srgb(value[:, None] * (1.0 - chroma[:, None] * (1.0 - jnp.clip(wheel, 0.0, 1.0))))


def _placed(options: PairConfig, stroke: Stroke, depth, most, place, rotate):
    """The stroke as stamps, its middle at `place` (2,) [mm], turned; smaller where its way, lifting
    included, is longer than `most` [mm] or than there are stamps."""
    way = jnp.sum(jnp.sqrt(jnp.sum(jnp.diff(stroke.position, axis=0) ** 2, axis=1) + 1e-12))
    lift = depth * jnp.sum(jnp.abs(jnp.diff(stroke.pressure)))
    room = jnp.maximum(min(most, 0.95 * options.stamps * options.spacing) - lift, 1.0)
    middle = 0.5 * (stroke.position.max(0) + stroke.position.min(0))
    stroke = transform(
        stroke,
        rotate=rotate,
        translate=place - middle,
        scale=jnp.minimum(1.0, room / way),
        center=middle,
    )
    return resample(stroke, options.stamps, options.spacing, np.inf, depth)


@jax.jit
def _draw_stroke(options: PairConfig, key, depth):
    """A stroke that fits the canvas, turned at random; it may leave the canvas."""
    own, turn, shift = jax.random.split(key, 3)
    side = options.size * options.paint.pixel
    place = jax.random.uniform(shift, (2,), minval=0.25 * side, maxval=0.75 * side)
    rotate = jax.random.uniform(turn, (), maxval=2.0 * np.pi)
    stroke = random_stroke(own, 128, 0.8 * side)
    return _placed(options, stroke, depth, options.way, place, rotate)


def _draw_brush(options: PairConfig, key):
    """The brush of `draw`: its params, those of its paint, and its width [mm]."""
    shape, *_ = jax.random.split(key, 6)
    return _make_brush(options, SHAPES[int(jax.random.randint(shape, (), 0, len(SHAPES)))], key)


@functools.partial(jax.jit, static_argnums=1)
def _make_brush(options: PairConfig, name: str, key):
    _, size, hair, *_ = jax.random.split(key, 6)
    low, high = (1.4, 2.8) if name == "round" else (1.8, 4.0)
    width = jax.random.uniform(size, (), minval=low, maxval=high)
    thickness = width if name == "round" else jnp.maximum(0.7, 0.3 * width)
    length = 6.0 + 3.0 * width
    brush = make_brush(
        hair, options.brush, name, options.bristles, width=width, thickness=thickness,
        length=length, press_depth=0.25 * length,
    )  # fmt: skip
    disc = name == "round"
    return brush, for_brush(make_params(), width, thickness, options.bristles, disc), width


@jax.jit
def _draw_load(options: PairConfig, key, dry: float):
    """The mix and the load of `draw`, as `Plan` has them."""
    *_, color, load = jax.random.split(key, 6)
    first, second, blend = jax.random.split(color, 3)
    pick = lambda k: jax.nn.one_hot(  # noqa: E731
        jax.random.randint(k, (), 0, options.paint.pigments), options.paint.pigments
    )
    # Every third stroke is mixed from two.
    share = jnp.maximum(0.0, jax.random.uniform(blend, (), minval=-1.0, maxval=0.5))
    # Mostly full, some so dry that they catch on a coarse weave.
    full = 1.0 - 0.75 * jax.random.uniform(load, ()) ** 2
    choice, least = jax.random.uniform(jax.random.fold_in(load, 1), (2,))
    return (
        (1.0 - share) * pick(first) + share * pick(second),
        jnp.where(choice < dry, 0.05 + 0.2 * least, full),
    )


def draw(options: PairConfig, key) -> Plan:
    """Draws one stroke: brush, hand, load and color."""
    hand = jax.random.split(key, 6)[3]
    brush, paint, _ = _draw_brush(options, key)
    mix, load = _draw_load(options, key, DRY)
    stroke = _draw_stroke(options, hand, brush.press_depth)
    return Plan(stroke=stroke, brush=brush, paint=paint, mix=mix, load=load)


def draw_beside(options: PairConfig, key, number: int) -> Plan:
    """Draws stroke `number` of a canvas that is painted as an area is: with one brush, in strokes
    side by side that overlap, some to and fro, and longer than those of `draw`, so that they cross
    the canvas; most of them `PULLED`. Load, color and pressure are each stroke's own.

    Strokes at random hardly ever go along the edge of another. Networks that saw those alone left a
    band of the old color there, wider after more training.

    Args:
      key: of the canvas, from which `draw` has `fold_in(key, number + 1)` for this stroke.
    """
    own = jax.random.fold_in(key, number + 1)
    brush, paint, width = _draw_brush(options, jax.random.fold_in(key, 1))
    stroke = _draw_beside(options, key, own, number, width, brush.press_depth)
    mix, load = _draw_load(options, own, DRY_BESIDE)
    return Plan(stroke=stroke, brush=brush, paint=paint, mix=mix, load=load)


@jax.jit
def _draw_beside(options: PairConfig, key, own, number, width, depth):
    """The stroke of `draw_beside`."""
    path, layout = jax.random.split(jax.random.fold_in(key, options.strokes + 1))
    choice, gap, to_and_fro, pull, *place = jax.random.uniform(layout, (6,))
    along, aside = jax.random.uniform(jax.random.fold_in(own, 0), (2,), minval=-0.1, maxval=0.1)
    side = options.size * options.paint.pixel
    # Straight, or an arc, or an S.
    kind = jnp.searchsorted(jnp.asarray([0.6, 0.9], choice.dtype), choice)
    stroke = random_stroke(path, 128, 1.6 * side, kind)
    hand = random_stroke(jax.random.fold_in(own, 1), 128, 1.6 * side, kind)
    chord = stroke.position[-1] - stroke.position[0]
    chord = chord / jnp.sqrt(jnp.sum(chord * chord) + 1e-12)
    normal = jnp.stack([-chord[1], chord[0]])
    # Three to nine tenths of the brush's width between neighbours.
    away = (number - 0.5 * (options.strokes - 1)) * (0.3 + 0.6 * gap) + aside
    middle = side * (0.35 + 0.3 * jnp.stack(place)) + width * away * normal + side * along * chord
    back = (to_and_fro > 0.5) & (number % 2 == 1)
    position = jnp.where(back, stroke.position[::-1], stroke.position)
    heading = jnp.arctan2(chord[1], chord[0])
    ahead = heading + jnp.where(back, np.pi, 0.0)
    step = jnp.sqrt(jnp.sum(jnp.diff(position, axis=0) ** 2, axis=1) + 1e-12)
    share = jnp.pad(jnp.cumsum(step), (1, 0)) / jnp.sum(step)
    steady = jnp.minimum(1.0, jnp.minimum(share / 0.12, (1.0 - share) / 0.15))
    pulled = pull < PULLED
    stroke = dataclasses.replace(
        stroke,
        position=position,
        pressure=jnp.where(pulled, hand.pressure.max() * steady, hand.pressure),
        altitude=jnp.where(pulled, stroke.altitude - 0.13, stroke.altitude),
        # Around the way ahead, where it would be around 0.8.
        azimuth=jnp.where(pulled, ahead + stroke.azimuth - 0.8, stroke.azimuth),
        # Its broad side ahead, more or less.
        twist=heading + 0.5 * np.pi + 0.4 * stroke.twist,
    )
    return _placed(options, stroke, depth, np.inf, middle, 0.0)


def paint_pair(options: PairConfig, plan: Plan, palette, relief, canvas):
    """Paints one stroke of a plan. Pure; jit and vmap it.

    Args:
      relief: () depth of the canvas's weave [mm]. canvas: with `MARGIN` pixels more on each side
        than the pair keeps.

    Returns:
      (canvas after (z, k, y, x), Picture).
    """
    track = rollout(options.brush, plan.brush, plan.stroke)
    edge = MARGIN * options.paint.pixel
    shift = jnp.asarray([edge, edge, 0.0], track.position.dtype)[None, None, :, None]
    moved = dataclasses.replace(track, position=track.position + shift)
    dipped: BrushPaint = load_brush(
        options.paint, plan.paint, options.bristles, plan.load, plan.mix
    )
    tooth = weave(canvas.shape[2:], options.paint.pixel, relief, first=(-MARGIN, -MARGIN))
    after, _, report = paint_stroke(options.paint, plan.paint, canvas, dipped, moved, tooth)
    kept = slice(MARGIN, MARGIN + options.size)
    seen = lambda c: flatten(  # noqa: E731
        c[:, :, kept, kept], options.paint.layer, palette, plan.paint.opacity, mixing="subtractive"
    )
    # The color of the load as thick paint shows it.
    thick = plan.mix[None, :, None, None] * jnp.full((1, 1, 1, 1), 1e3)
    own = flatten(
        thick, options.paint.layer, palette, plan.paint.opacity, mixing="subtractive"
    ).color[0, 0]
    grid = make_grid((options.size, options.size), pixel=options.paint.pixel)
    drawn = on_way(
        loaded(track, plan.brush, plan.load, relief), plan.stroke, plan.brush.press_depth
    )
    drawn = jax.tree.map(lambda x: x[:: options.every], drawn)
    before, now = seen(canvas), seen(after)
    told, maps = drawn_maps(grid, drawn, before, own)
    return after, Picture(
        height=before.height,
        color=to_srgb(before.color),
        **told,
        new_height=now.height,
        new_color=to_srgb(now.color),
        mask=dilate(maps.coverage, REACH),
        reached=jnp.all(report.reached),
    )


_paint_pair = jax.jit(paint_pair)
_paint_pairs = jax.jit(jax.vmap(paint_pair, in_axes=(None, 0, 0, 0, 0)))


def _begun(options: PairConfig, seed: int, number: int):
    """Palette of a canvas, the relief of its weave, and `plan(stroke)` of its strokes."""
    key = jax.random.fold_in(jax.random.key(seed), number)
    deep = jax.random.uniform(jax.random.fold_in(key, options.strokes + 2), (), minval=-1.0)
    relief = RELIEF + (options.relief - RELIEF) * jnp.maximum(deep, 0.0)

    def plan(stroke: int) -> Plan:
        if options.beside and number % options.beside == options.beside - 1:
            return draw_beside(options, key, stroke)
        return draw(options, jax.random.fold_in(key, stroke + 1))

    return draw_palette(jax.random.fold_in(key, 0), options.paint.pigments), relief, plan


def canvas_pairs(options: PairConfig, seed: int, number: int):
    """All pairs of one canvas.

    Args:
      seed: of the data set. number: of the canvas.

    Returns:
      list of `strokes` Pictures, numpy arrays.
    """
    palette, relief, plan = _begun(options, seed, number)
    shape = (options.size + 2 * MARGIN,) * 2
    canvas, pictures = empty_canvas(options.paint, shape), []
    for stroke in range(options.strokes):
        canvas, picture = _paint_pair(options, plan(stroke), palette, relief, canvas)
        pictures.append(jax.tree.map(np.asarray, picture))
    return pictures


def canvases_pairs(options: PairConfig, seed: int, numbers):
    """`canvas_pairs` of several canvases, a list for each, painted side by side: for a GPU, which
    one canvas does not fill. The same but for rounding, which moves single grooves."""
    palettes, reliefs, plans = zip(*(_begun(options, seed, n) for n in numbers), strict=True)
    shape = (options.size + 2 * MARGIN,) * 2
    stacked = lambda trees: jax.tree.map(lambda *x: jnp.stack(x), *trees)  # noqa: E731
    canvas, palette = stacked([empty_canvas(options.paint, shape)] * len(plans)), stacked(palettes)
    reliefs = jnp.stack(reliefs)
    strokes = []
    for stroke in range(options.strokes):
        drawn = stacked([plan(stroke) for plan in plans])
        canvas, picture = _paint_pairs(options, drawn, palette, reliefs, canvas)
        strokes.append(jax.device_get(picture))
    return [[jax.tree.map(lambda x, k=k: x[k], p) for p in strokes] for k in range(len(plans))]
