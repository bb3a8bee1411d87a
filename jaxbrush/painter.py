"""The neural painting system: a stroke in, the painted canvas out (paper section 4.4).

`paint_stroke` picks the sizes of a stroke and runs its stages one by one. Sizes are bucketed: for s
buckets of stamps, b of boxes and n of patch counts in use, any number of strokes on canvases of one
size compiles `trace` s times, `draw` at most s * b times, `cut` and `lay` at most b * n times, and
the networks n times. A stroke painted in one piece has in place of box and count a rectangle, of r
shapes. What is compiled besides is small.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush import checkpoint, patches
from jaxbrush.brush import BrushParams
from jaxbrush.canvas import Canvas
from jaxbrush.loaded import LOAD, REACH
from jaxbrush.models import inputs_of
from jaxbrush.patches import Box, Layout, Rect
from jaxbrush.raster import trajectory_maps
from jaxbrush.stages import Nets as Nets
from jaxbrush.stages import PainterConfig as PainterConfig
from jaxbrush.stages import (
    Sizes,
    check_canvas,
    cut,
    draw,
    evaluate,
    lay,
    place_stamps,
    preview,
    touches,
    trace,
)
from jaxbrush.stages import paint_on as paint_on
from jaxbrush.stylus import Stroke, stamps_needed

HEIGHT_INPUTS, COLOR_INPUTS, MIXED_INPUTS = 9, 8, 15
"""Channels that the networks are given: height, color, and color of one that mixes."""


def make_nets(height: checkpoint.Exported, color: checkpoint.Exported) -> Nets:
    """Both networks of a painter.

    Raises:
      ValueError: networks of other inputs or outputs.
    """
    colors = MIXED_INPUTS if color.config.mixes else COLOR_INPUTS
    for name, net, inputs, outputs in (
        ("height", height, HEIGHT_INPUTS, 1), ("color", color, colors, 3),
    ):  # fmt: skip
        have = inputs_of(net.config, net.variables["params"])
        if (have, net.config.outputs) != (inputs, outputs):
            raise ValueError(
                f"the {name} network has {have} inputs and {net.config.outputs} outputs: expected "
                f"{inputs} and {outputs}"
            )
    return Nets(height.variables, color.variables, height.config, color.config)


def load_nets(height_path, color_path) -> Nets:
    """Reads both networks from files of `checkpoint.export`.

    Raises:
      ValueError: as `checkpoint.load` and `make_nets`.
    """
    return make_nets(checkpoint.load(height_path), checkpoint.load(color_path))


def _trace_bounds(options, brush, stroke, load):
    track = trace(options, brush, stroke, load)
    return track, touches(options, track)


def _needed(options, brush, stroke):
    return stamps_needed(stroke, options.pixel, np.inf, brush.press_depth)


def _draw_and_count(options, box, canvas, track, color, laid=None):
    drawn = draw(options, box, canvas, track, color, laid)
    if isinstance(box, Rect):
        return drawn, jnp.any(drawn.mask > 0.0).astype(jnp.int32)
    return drawn, patches.needed(options.patches, box, drawn.mask[..., 0])


def _cut_some(options, box, drawn, canvas, count):
    if isinstance(box, Rect):
        return box, cut(options, box, drawn, canvas, box)
    layout = patches.layout(options.patches, box, drawn.mask[..., 0], count)
    return layout, cut(options, box, drawn, canvas, layout)


def _take(pairs, start, size):
    return jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, size), pairs)


def _put(painted, some, start):
    return jax.lax.dynamic_update_slice_in_dim(painted, some, start, 0)


_needed_stamps = jax.jit(_needed)
_place_stamps = jax.jit(place_stamps, static_argnames="stamps")
_trace = jax.jit(_trace_bounds)
draw_on = jax.jit(_draw_and_count)
_cut = jax.jit(_cut_some, static_argnames="count")
_evaluate = jax.jit(evaluate)
_take_some = jax.jit(_take, static_argnames="size")
_put_some = jax.jit(_put, donate_argnums=0)
_lay = jax.jit(lay)
_lay_over = jax.jit(lay, donate_argnames="canvas")


def bucket(size: int, buckets) -> int:
    return next((b for b in buckets if size <= b), buckets[-1])


def _count(options: PainterConfig, need: int) -> int:
    """Patches are counted in powers of 2 and halfway between them, at least a batch."""
    power = 1 << max(need - 1, 0).bit_length()
    return max(4, options.batch, 3 * power // 4 if need <= 3 * power // 4 else power)


def check_load(load):
    """Raises ValueError unless 0 < load <= 1."""
    if not 0.0 < float(load) <= 1.0:
        raise ValueError(f"load = {load!r}: expected a share of what the brush holds, in (0, 1]")


def padded(stroke: Stroke) -> Stroke:
    """A stroke with a power of 2 of samples, by numpy: each length would compile anew."""
    have = stroke.time.shape[0]
    if not all(np.all(np.isfinite(np.asarray(x))) for x in jax.tree.leaves(stroke)):
        raise ValueError("stroke holds samples that are not finite: expected numbers")
    extra = max(128, 1 << (have - 1).bit_length()) - have
    longer = jax.tree.map(lambda x: np.concatenate([x, np.repeat(x[-1:], extra, 0)]),
                          jax.tree.map(np.asarray, stroke))  # fmt: skip
    longer.valid[have:] = False
    return longer


def _begin(options: PainterConfig, brush: BrushParams, stroke: Stroke, load=LOAD):
    """Track and touches of a stroke, stamps in a bucket; not jittable."""
    stroke = padded(stroke)
    stamps = bucket(int(_needed_stamps(options, brush, stroke)), options.stamps)
    placed = _place_stamps(options, brush, stroke, stamps=stamps)
    return _trace(options, brush, placed, jnp.asarray(load, float))


def reached(shape, bounds) -> tuple[slice, slice] | None:
    """The rows and columns of a canvas (h, w) that a stroke may change, None if there are none.

    Args:
      bounds: (t, 4) from `stages.touches`.

    Raises:
      ValueError: a track that is not finite.
    """
    bounds = np.asarray(bounds)
    if not np.all(np.isfinite(bounds)):
        raise ValueError("the track of the stroke is not finite: check its samples and the brush")
    low = np.maximum(bounds[:, :2].min(0) - REACH, 0.0)
    high = np.minimum(bounds[:, 2:].max(0) + REACH, np.asarray(shape, float))
    if np.any(low >= high):
        return None
    return slice(int(low[0]), int(high[0])), slice(int(low[1]), int(high[1]))


MARGIN = 8
"""Pixels round the mask of a stroke that is painted in one piece."""


def place(options: PainterConfig, shape, bounds) -> Box | Rect | None:
    """The box of what a stroke may change on a canvas (h, w), or its rectangle where that is less
    work; None if it changes nothing. Not jittable."""
    there = reached(shape, bounds)
    if there is None:
        return None
    low, high = ([getattr(s, end) for s in there] for end in ("start", "stop"))
    if options.moments == "stroke":
        rect = patches.rect_of(low, high, MARGIN, options.sides)
        if rect is not None:
            bounds = np.asarray(bounds)
            first = np.maximum(bounds[:, :2] - REACH, 0.0).astype(int)
            last = np.minimum(bounds[:, 2:] + REACH, np.asarray(shape, float)).astype(int)
            count = _count(options, patches.patches_along(options.patches, first, last))
            if rect.sides[0] * rect.sides[1] <= count * options.patches.size**2:
                return rect
    return patches.box_of(options.patches, np.asarray(low), np.asarray(high), options.cells)


PIECES = (96, 192)
"""Sides of the rectangles that a preview is drawn in [pixels]: few, for few compilations."""


def place_piece(options: PainterConfig, shape, bounds) -> Box | Rect | None:
    """The rectangle that a few stamps draw in, None if they draw nothing; not jittable."""
    there = reached(shape, bounds)
    if there is None:
        return None
    low, high = ([getattr(s, end) for s in there] for end in ("start", "stop"))
    rect = patches.rect_of(low, high, 0, PIECES)
    return place(options, shape, bounds) if rect is None else rect


def plan(options: PainterConfig, canvas: Canvas, brush: BrushParams, stroke: Stroke):
    """Sizes and first patch for `paint_on`; not jittable.

    Returns:
      (Sizes, (2,) int), or None if the stroke does not touch the canvas.
    """
    track, bounds = _begin(options, brush, stroke)
    shape = canvas.height.shape
    box = place(options, shape, bounds)
    if box is None:
        return None
    if isinstance(box, Rect):
        return Sizes(track.time.shape[0], sides=box.sides), box.corner
    _, need = draw_on(options, box, canvas, track, jnp.zeros(3))
    sizes = Sizes(track.time.shape[0], box.cells, _count(options, int(need)))
    return sizes, box.first


def paint_stroke(
    options: PainterConfig, nets: Nets, canvas: Canvas, brush: BrushParams, color, stroke: Stroke,
    donate: bool = False, watch=lambda stage, value: None, load=LOAD,
) -> Canvas:  # fmt: skip
    """Paints one stroke on a canvas; picks the sizes itself, so it cannot be jitted.

    Args:
      nets: from `load_nets`. canvas: (h, w) of any size. brush: of `options.brush`. color: (3,) of
        the paint, linear RGB. stroke: samples of the stylus [mm] on the canvas; may leave it.
      donate: paints into the canvas that is given, which is then gone; else all of it is copied.
      watch: called after each stage with its name and what it made: brush (track, bounds), maps,
        patches, networks, canvas.
      load: share of what the brush holds that it is loaded with, (0, 1].

    Returns:
      Canvas; pixels that the dilated stroke does not reach keep their bits.

    Raises:
      ValueError: shapes that do not fit, a box larger than PainterConfig.cells, a stroke or brush
        that is not finite, a load out of range.
    """
    check_canvas(canvas)
    check_load(load)
    track, bounds = _begin(options, brush, stroke, load)
    watch("brush", (track, bounds))
    return paint_track(options, nets, canvas, track, bounds, color, donate, watch)


def paint_track(
    options: PainterConfig, nets: Nets, canvas: Canvas, track, bounds, color,
    donate: bool = False, watch=lambda stage, value: None,
) -> Canvas:  # fmt: skip
    """`paint_stroke` from the track of its bristles on, which is that of `stages.trace`, and its
    touches."""
    shape = canvas.height.shape
    box = place(options, shape, bounds)
    if box is None:
        return canvas
    drawn, need = draw_on(options, box, canvas, track, jnp.asarray(color, float))
    watch("maps", drawn)
    need = int(need)
    if not need:
        return canvas
    layout, pairs = _cut(options, box, drawn, canvas, count=_count(options, need))
    watch("patches", pairs)
    painted = paint_patches(options, nets, pairs, layout)
    watch("networks", painted)
    canvas = (_lay_over if donate else _lay)(options, box, drawn, canvas, layout, painted)
    watch("canvas", canvas)
    return canvas


def paint_patches(options: PainterConfig, nets: Nets, pairs: dict, layout: Layout | Rect):
    """`evaluate`, batch by batch of the patches that are there, layout as there; not jittable."""
    if options.moments == "stroke":
        return _evaluate(options, nets, pairs, layout)
    count, size = pairs["mask"].shape[0], options.batch
    painted = jnp.zeros((*pairs["mask"].shape[:3], 4))
    for start in range(0, int(jnp.sum(layout.present)), size):
        start = min(start, count - size)
        some = _evaluate(options, nets, _take_some(pairs, start, size=size))
        painted = _put_some(painted, some, start)
    return painted


_preview = jax.jit(preview)
_preview_over = jax.jit(preview, donate_argnames="canvas")


def preview_stroke(
    options: PainterConfig, canvas: Canvas, brush: BrushParams, color, stroke: Stroke,
    donate: bool = False,
) -> Canvas:  # fmt: skip
    """Paints one stroke without networks, from its maps alone; arguments as in `paint_stroke`."""
    check_canvas(canvas)
    track, bounds = _begin(options, brush, stroke)
    box = place(options, canvas.height.shape, bounds)
    if box is None:
        return canvas
    color = jnp.asarray(color, float)
    drawn, _ = draw_on(options, box, canvas, track, color)
    return (_preview_over if donate else _preview)(options, box, drawn, canvas, color)


def _covered(options, box: Box | Rect, track):
    grid = patches.grid_of(options.patches, box, options.pixel)
    return trajectory_maps(grid, track).coverage > 0.0, patches.corner_of(options.patches, box)


_covered_jit = jax.jit(_covered)


def covered(options: PainterConfig, box: Box | Rect, track):
    """Where the bristles of a track draw: (h, w) bool on the pixels of a box, and (2,) the first
    pixel (y, x) of it on the canvas."""
    return _covered_jit(options, box, track)
