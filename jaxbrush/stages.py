"""Stages of the neural painting system (paper section 4.4), each a pure function, and `paint_on`,
which joins them in one function of fixed sizes, to jit and differentiate:

  place_stamps, trace   stylus -> track of the bristles with their coat of paint
  draw                  track -> trajectory maps and mask on the box of the stroke
  cut                   maps and canvas -> patches where the mask is
  evaluate              patches -> painted: the height network, the color network on its output
  blend, lay            painted patches -> tiles -> canvas, where the mask is
  preview               maps -> canvas, without networks

`painter` picks the sizes and runs them.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush import batches, patches, poisson
from jaxbrush.brush import BristleTrack, BrushConfig, BrushParams, rollout
from jaxbrush.canvas import Canvas, from_srgb, to_srgb
from jaxbrush.loaded import LOAD, REACH, Loaded, drawn_maps, loaded, on_way
from jaxbrush.metrics import image_scale
from jaxbrush.models import Generator, GeneratorConfig
from jaxbrush.paint import RELIEF
from jaxbrush.patches import Box, Layout, PatchConfig, Rect
from jaxbrush.raster import WIDTH, dilate
from jaxbrush.structs import config, state
from jaxbrush.stylus import Stroke, resample

BLENDS = ("cut", "feather", "poisson")
MOMENTS = ("patch", "stroke")
NOWHERE = 1e9
"""Bounds [pixels] of what touches nothing: they begin there and end at minus that."""


@config
class PainterConfig:
    """Static choices.

    pixel: side of a pixel of the canvas [mm], that of the training pairs. relief: depth of its
    weave [mm], on one of some 0.09 a dry brush catches. brush: how bristles are simulated. patches:
    how a stroke is cut. blend: how patches become one picture, one of BLENDS. moments: "patch",
    each normalised by its own moments; or "stroke", by those of all of its stroke, which are then
    painted at once and show no seam side by side ("cut"). edge: of soft maps [mm], or None for
    exact ones. stamps: buckets of stamps; a stroke that needs more gets the most, further apart.
    cells: buckets of the side of a box, in patches. sides: buckets of the sides [pixels] of the
    rectangle round a stroke, which is painted in one piece, without patches, where that is fewer
    pixels and moments are "stroke"; () is never. batch: patches that the networks are given at
    once, where moments allow.
    """

    pixel: float = 0.125
    relief: float = RELIEF
    brush: BrushConfig = BrushConfig()  # noqa: RUF009
    patches: PatchConfig = PatchConfig()  # noqa: RUF009
    blend: str = "cut"
    moments: str = "stroke"
    edge: float | None = None
    stamps: tuple[int, ...] = (64, 128, 256, 512, 1024, 2048, 4096)
    cells: tuple[int, ...] = (2, 3, 4, 6, 8, 12, 16, 24, 32, 48)
    sides: tuple[int, ...] = (80, 128, 256, 512)
    batch: int = 1

    def __post_init__(self):
        for name, known in (("blend", BLENDS), ("moments", MOMENTS)):
            if getattr(self, name) not in known:
                raise ValueError(
                    f"PainterConfig.{name} = {getattr(self, name)!r}: expected one of {known}"
                )
        for name, least in (("stamps", 2), ("cells", 1)):
            value = getattr(self, name)
            if not value or min(value) < least or list(value) != sorted(set(value)):
                raise ValueError(
                    f"PainterConfig.{name} = {value}: expected rising numbers of at least {least}"
                )
        if list(self.sides) != sorted(set(self.sides)) or any(n < 4 or n % 4 for n in self.sides):
            raise ValueError(
                f"PainterConfig.sides = {self.sides}: expected rising multiples of 4, or none"
            )
        if not 0.0 <= self.relief < np.inf:
            raise ValueError(f"PainterConfig.relief = {self.relief}: expected >= 0 mm")
        if not self.pixel > 0.0 or self.batch < 1:
            raise ValueError(
                f"PainterConfig.pixel = {self.pixel}, batch = {self.batch}: expected a positive "
                "side and at least 1"
            )


@config
class Sizes:
    """What fixes the shapes of a stroke. stamps: of the track. cells: rows and columns of patches
    of its box. count: of patches. sides: of its rectangle, painted in one piece; then there are no
    patches."""

    stamps: int
    cells: tuple[int, int] | None = None
    count: int = 0
    sides: tuple[int, int] | None = None


@state
class Nets:
    """Variables of the height and the color network; their configs are static."""

    height: dict
    color: dict
    height_config: GeneratorConfig = dataclasses.field(metadata={"static": True})
    color_config: GeneratorConfig = dataclasses.field(metadata={"static": True})


@state
class Drawn:
    """Maps of a stroke on the grid of its box: pressure, sweeps, time [mm], load, tip, film, hair
    [mm], lift (h, w, 1), trajectory, picked (h, w, 3) in sRGB, as in a training pair; mask:
    (h, w, 1) as there, 0 off the canvas. share: (h, w, 1) of what is painted in what the canvas
    becomes: 1 where bristles came, falling to 0 within `RIM`. whole: () as in TrajectoryMaps."""

    pressure: jax.Array
    sweeps: jax.Array
    time: jax.Array
    load: jax.Array
    tip: jax.Array
    film: jax.Array
    hair: jax.Array
    lift: jax.Array
    trajectory: jax.Array
    picked: jax.Array
    mask: jax.Array
    share: jax.Array
    whole: jax.Array


RIM = 4
"""Pixels beyond the bristles in which a stroke fades into the canvas. In 112 test pairs the
simulator changes 0.8 % of a stroke's paint there, 0.1 % beyond; from the second pixel on networks
are farther off than the canvas as it was, and a sharp edge shows as an outline."""


def check_canvas(canvas: Canvas):
    """Raises ValueError unless height and color have one size."""
    h, w = canvas.height.shape
    if min(h, w) < 1 or canvas.color.shape != (h, w, 3):
        raise ValueError(
            f"canvas of height {canvas.height.shape} and color {canvas.color.shape}: expected "
            "(h, w) and (h, w, 3)"
        )


def place_stamps(options: PainterConfig, brush: BrushParams, stroke: Stroke, stamps: int):
    """The stroke as `stamps` (static) stamps at most a pixel apart, as in training pairs."""
    return resample(stroke, stamps, options.pixel, np.inf, brush.press_depth)


def trace(options: PainterConfig, brush: BrushParams, stroke: Stroke, load=LOAD) -> Loaded:
    """Moves a loaded brush along the stamps of a stroke; the track's clock is the way [mm]."""
    track = loaded(rollout(options.brush, brush, stroke), brush, load, options.relief)
    return on_steps(options, on_way(track, stroke, brush.press_depth))


STEPS = 2048
"""Of a pixel, on which bristles of exact maps stand: 24 bits then hold their places on a canvas of
4096 pixels, and on every patch of it, alike."""


def on_steps(options: PainterConfig, track: BristleTrack) -> BristleTrack:
    """The track with bristles on `STEPS`, so that all patches see it the same to the bit; as it is
    for soft maps, which have slopes in the places."""
    if options.edge is not None:
        return track
    step = options.pixel / STEPS
    return dataclasses.replace(track, position=jnp.round(track.position / step) * step)


def touches(options: PainterConfig, track: BristleTrack):
    """Where the bristles draw on their way to each stamp: (t, 4) first y, x and last y, x [pixels]
    of the canvas that anything of it touches; NaN where the track is not finite."""
    tip, force = track.position[:, -1, :2], track.force[:, -1]
    start = jnp.concatenate([tip[:1], tip[:-1]])
    known = track.valid & jnp.concatenate([track.valid[:1], track.valid[:-1]])
    soft = 0.0 if options.edge is None else options.edge
    down = (force > 0.0) | (track.position[:, -1, 2] < 0.5 * soft)
    down = (down | jnp.concatenate([down[:1], down[:-1]])) & known[:, None]
    reach = 0.5 * (WIDTH + soft)
    low = jnp.where(down[:, None], jnp.minimum(tip, start) - reach, NOWHERE)
    high = jnp.where(down[:, None], jnp.maximum(tip, start) + reach, -NOWHERE)
    low = jnp.floor(jnp.min(low, axis=-1) / options.pixel)[:, ::-1] - 1.0
    high = jnp.ceil(jnp.max(high, axis=-1) / options.pixel)[:, ::-1] + 1.0
    bounds = jnp.concatenate([low, high], axis=1)
    sound = jnp.all(jnp.isfinite(tip), axis=(1, 2)) | ~track.valid
    return jnp.where(sound[:, None], bounds, jnp.nan)


def faded(cover):
    """Coverage (h, w) to the share of what is painted: 1 a pixel beyond it, 0 after `RIM`; and
    coverage dilated by `RIM`."""
    share = jnp.zeros_like(cover)
    for _ in range(RIM):
        cover = dilate(cover, 1)
        share = share + cover / RIM
    return share, cover


def draw(
    options: PainterConfig, box: Box | Rect, canvas: Canvas, track: Loaded, color, laid=None
) -> Drawn:  # fmt: skip
    """Draws the maps of a stroke on its box, scaled as in training pairs.

    Args:
      canvas: before the stroke. track: from `trace`. color: (3,) of the paint, linear RGB. laid: as
        in `drawn_maps`, on a box that does not hold all of the stroke.
    """
    grid, shape = patches.grid_of(options.patches, box, options.pixel), canvas.height.shape
    told, maps = drawn_maps(grid, track, canvas, color, options.edge, laid)
    at = patches.corner_of(options.patches, box)
    row, column = (at[k] + jnp.arange(grid.shape[k], dtype=jnp.int32) for k in (0, 1))
    inside = ((row >= 0) & (row < shape[0]))[:, None] & ((column >= 0) & (column < shape[1]))[None]
    inside = inside.astype(maps.coverage.dtype)[..., None]
    # Kept as an array: worked out again at every shift of the dilation it is slow.
    cover = jax.lax.optimization_barrier(maps.coverage)
    share, grown = faded(cover)
    return Drawn(
        **{name: x.reshape(*grid.shape, -1) for name, x in told.items()},
        mask=inside * dilate(grown, REACH - RIM)[..., None],
        share=inside * share[..., None],
        whole=maps.whole,
    )


def cut(
    options: PainterConfig, box: Box | Rect, drawn: Drawn, canvas: Canvas, layout: Layout | Rect
) -> dict:
    """Patches of the maps and of the canvas under them, in the form of training pairs.

    Args:
      layout: of the box; a Rect is its own.

    Returns:
      dict of height [mm], pressure, sweeps, time, load, tip, film, hair, lift, mask, share (n,
      size, size, 1), color, trajectory, picked (n, size, size, 3) in sRGB; of a Rect one, of its
      sides.
    """
    names = (
        "pressure", "sweeps", "time", "load", "tip", "film", "hair", "lift", "mask", "share",
        "trajectory", "picked",
    )  # fmt: skip
    field = jnp.concatenate([getattr(drawn, name) for name in names], axis=-1)
    if isinstance(box, Rect):
        field, corner = field[None], box.corner[None]
    else:
        field, corner = patches.cut(options.patches, box, field, layout.corner), layout.corner
    sides = field.shape[1:3]
    return {
        "height": patches.cut_canvas(canvas.height, corner, sides)[..., None],
        "color": to_srgb(patches.cut_canvas(canvas.color, corner, sides)),
        **dict(zip(names, jnp.split(field, (*range(1, 11), 13), axis=-1), strict=True)),
    }


SHARE = 0.3
"""Of the pixels of a training pair, those in the stroke's mask (mean)."""


def balanced(mask):
    """Weights (1, h, w, 1) of pixels in the moments of a tight rectangle, where the stroke counts
    for no more than in a training pair. On test pairs cut down to their stroke, networks are as
    good as on all of them: 0.125 (all: 0.134) and 0.134 (0.133) with a margin of 8 pixels."""
    share = jnp.mean(mask)
    aim = jnp.minimum(share, SHARE)
    inside, outside = aim / jnp.maximum(share, 1e-6), (1.0 - aim) / jnp.maximum(1.0 - share, 1e-6)
    return outside + mask * (inside - outside)


def evaluate(
    options: PainterConfig, nets: Nets, pairs: dict, layout: Layout | Rect | None = None
):  # fmt: skip
    """Paints patches: the height network, then the color network on its output.

    Args:
      pairs: n patches from `cut`. layout: where they are, for moments of the whole stroke: with it
        the color network is given the blended height.

    Returns:
      (n, size, size, 4) in image scale: height as a share of the largest, sRGB.
    """
    pooled = options.moments == "stroke" and not isinstance(layout, Rect)
    core = balanced(pairs["mask"]) if isinstance(layout, Rect) else None
    if pooled:
        core = jnp.asarray(patches.core(options.patches))[None]
        core = core * jnp.ones((pairs["mask"].shape[0], 1, 1, 1))
        if layout is not None:
            core = core * layout.present[:, None, None, None].astype(core.dtype)

    def run(generator, variables, inputs):
        weights = core
        if generator.norm == "masked":
            weights = pairs["mask"] if core is None else pairs["mask"] * core
        found = Generator(generator).apply(variables, inputs, weights, pooled=pooled)
        return image_scale(found)

    level = batches.LEVELS["height"]
    before = jnp.clip(pairs["height"], 0.0, level)
    # Chosen where there is none: a root has no slope at 0.
    press = jnp.where(pairs["pressure"] > 0.0, pairs["pressure"], 0.0)
    given = pairs | {
        "height": before, "pressure": press, "new_height": before, "new_color": pairs["color"],
    }  # fmt: skip
    height = run(nets.height_config, nets.height, batches.height_batch(given).inputs)
    laid = height
    if pooled and layout is not None:
        # Patches see one height wherever they overlap, as if there were one picture.
        laid = patches.recut(options.patches, blend(options, height, layout), layout)
    # The canvas as it will be.
    given["new_height"] = before + pairs["share"] * (level * laid - before)
    seen = batches.color_batch(given, mixes=nets.color_config.mixes).inputs
    color = run(nets.color_config, nets.color, seen)
    return jnp.concatenate([height, color], axis=-1)


def blend(options: PainterConfig, painted, layout: Layout):
    """Tiles (m, step, step, c) of painted patches (n, size, size, c)."""
    if options.blend == "poisson":
        return poisson.merge(options.patches, painted, layout)
    return patches.merge(options.patches, painted, layout, sharp=options.blend == "cut")


def lay(
    options: PainterConfig, box: Box | Rect, drawn: Drawn, canvas: Canvas, layout: Layout | Rect,
    painted,
) -> Canvas:  # fmt: skip
    """Blends painted patches and lays their share over the canvas."""
    if isinstance(box, Rect):
        tiles, share = painted, drawn.share[None, ..., 0]
    else:
        tiles = blend(options, painted, layout)
        share = patches.cut_tiles(options.patches, box, drawn.share[..., 0], layout)
    changed = share > 0.0

    def over(field, new):
        old = patches.cut_canvas(field, patches.tile_of(layout), new.shape[1:3])
        part = share.reshape(share.shape + (1,) * (new.ndim - 3))
        step = jnp.where(part > 0.0, part * (new - old), 0.0)
        return patches.place(old + step, layout, field, changed)

    return Canvas(
        height=over(canvas.height, batches.LEVELS["height"] * tiles[..., 0]),
        color=over(canvas.color, from_srgb(tiles[..., 1:])),
    )


def paint_on(
    options: PainterConfig, sizes: Sizes, nets: Nets, canvas: Canvas, brush: BrushParams, color,
    stroke: Stroke, first, load=LOAD,
):  # fmt: skip
    """Paints one stroke in given sizes; pure: jit it, and differentiate it in all but `first`. For
    slopes of positions `options.edge` makes the maps soft.

    Args:
      sizes, first: from `plan`; first (2,) int is the number of the box's first patch along y, x,
        or the first pixel of the rectangle.
      canvas: (h, w). color: (3,) of the paint, linear RGB. stroke: samples of the stylus [mm].
      load: () share of what the brush holds.

    Returns:
      (Canvas, ok): ok () bool is False if the count is too small, or soft maps have gaps.
    """
    check_canvas(canvas)
    first = jnp.asarray(first, jnp.int32)
    track = trace(options, brush, place_stamps(options, brush, stroke, sizes.stamps), load)
    if sizes.sides is not None:
        rect = Rect(corner=first, sides=sizes.sides)
        drawn = draw(options, rect, canvas, track, color)
        pairs = cut(options, rect, drawn, canvas, rect)
        painted = evaluate(options, nets, pairs, rect)
        return lay(options, rect, drawn, canvas, rect, painted), drawn.whole
    box = Box(first=first, cells=sizes.cells)
    drawn = draw(options, box, canvas, track, color)
    layout = patches.layout(options.patches, box, drawn.mask[..., 0], sizes.count)
    pairs = cut(options, box, drawn, canvas, layout)
    if options.moments == "stroke" or sizes.count <= options.batch:
        painted = evaluate(options, nets, pairs, layout)
    else:
        one = lambda pair: evaluate(  # noqa: E731
            options, nets, jax.tree.map(lambda x: x[None], pair)
        )[0]
        painted = jax.lax.map(one, pairs, batch_size=options.batch)
    return lay(options, box, drawn, canvas, layout, painted), layout.enough & drawn.whole


def preview(options: PainterConfig, box: Box | Rect, drawn: Drawn, canvas: Canvas, color) -> Canvas:
    """Lays a stroke over the canvas as `batches.preview` shows it, from its maps alone."""
    shape = canvas.height.shape
    corner = patches.corner_of(options.patches, box)
    touch = jnp.concatenate([drawn.pressure, drawn.time], axis=-1)
    sides = [min(a, b) for a, b in zip(shape, touch.shape, strict=False)]
    # Clipped here: XLA's own clamping is wrong in some releases.
    at = [jnp.clip(corner[k], 0, shape[k] - sides[k]) for k in (0, 1)]
    for k in (0, 1):
        # What is rolled in from the other end lies off the box.
        index = at[k] - corner[k] + jnp.arange(sides[k], dtype=jnp.int32)
        held = (index >= 0) & (index < touch.shape[k])
        touch = jax.lax.slice_in_dim(jnp.roll(touch, corner[k] - at[k], k), 0, sides[k], axis=k)
        touch = jnp.where(jnp.expand_dims(held, (1 - k, 2)), touch, 0.0)
    under = jax.lax.dynamic_slice(canvas.color, (*at, 0), (*sides, 3))
    shown = batches.preview(
        {
            "height": jax.lax.dynamic_slice(canvas.height, at, sides)[..., None],
            "pressure": touch[..., :1],
            "time": touch[..., 1:],
            # A choice between two colors, so it may as well be made in linear RGB.
            "color": under,
            "trajectory": jnp.broadcast_to(jnp.asarray(color, under.dtype), under.shape),
        }
    )
    height, color = shown["new_height"][..., 0], shown["new_color"]
    return Canvas(
        height=jax.lax.dynamic_update_slice(canvas.height, height, at),
        color=jax.lax.dynamic_update_slice(canvas.color, color, (*at, 0)),
    )
