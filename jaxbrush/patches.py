"""Overlapping patches of a stroke's box, and the picture that they make together (paper 4.4,
Figure 12).

Patches lie on a lattice of the canvas, so neither the rest of the stroke nor its box moves them:
number i starts at pixel i * step - overlap, along y and x. Its core begins `lead` pixels later, is
`step` long, and ends as far from its end as is left of the overlap. Cores tile the canvas, and a
patch is worth painting where its core holds a pixel of the stroke's mask. The overlap is shared out
as a generator sees: 15 pixels before and 24 behind; from 40 on it sees all it can from a core.

The picture is made in tiles that lie side by side: tile i has the pixels from i * step on. Patch i
covers it whole, patch i + 1 the last `overlap` pixels of it, so four patches have a part in it.

         i * step                        (i + 1) * step
  patch i ... |--------------------------|
              |               |----------|--- ... patch i + 1
              |     alone     | overlap  |
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.raster import Grid
from jaxbrush.structs import config, state

FAR = 2**20
"""Where a tile lies that is none [pixels]: off every canvas."""


@config
class PatchConfig:
    """size: side of a patch, a multiple of 4. overlap: of neighbours, a multiple of 8, less than
    half the size [pixels]."""

    size: int = 128
    overlap: int = 40

    def __post_init__(self):
        if self.overlap < 8 or self.overlap % 8:
            raise ValueError(f"overlap = {self.overlap}: expected a multiple of 8 of at least 8")
        if self.size % 4 or self.size <= 2 * self.overlap:
            raise ValueError(
                f"size = {self.size}: expected a multiple of 4 above 2 x overlap = "
                f"{2 * self.overlap}"
            )

    @property
    def step(self) -> int:
        """From a patch to the next [pixels]."""
        return self.size - self.overlap

    @property
    def lead(self) -> int:
        """From the start of a patch to that of its core, a multiple of 4 [pixels]."""
        return max(4, 2 * self.overlap // 5 // 4 * 4)


@state
class Box:
    """The part of the lattice that a stroke is painted in.

    first: (2,) int, number of its first patch along y and x. cells: (rows, columns) of patches,
    static.
    """

    first: jax.Array
    cells: tuple[int, int] = dataclasses.field(metadata={"static": True})


@state
class Rect:
    """A stroke's rectangle, painted in one piece: what takes the place of a Box where that is less
    work.

    corner: (2,) int, its first pixel y, x on the canvas. sides: (h, w) [pixels], static.
    """

    corner: jax.Array
    sides: tuple[int, int] = dataclasses.field(metadata={"static": True})


@state
class Layout:
    """Which patches and tiles of a box a stroke needs, up to n patches and m = 2 n + 2 tiles.

    corner: (n, 2) first pixel y, x of a patch on the canvas, that of the box where there is none.
    present: (n,) bool. tile: (m, 2) first pixel of a tile, `FAR` where there is none. cell: (m,)
    number of the tile in the box. parts: (m, 4) which patches have a part in a tile: its own, the
    next along x, along y, along both; n where that one is not painted. tiles: (n, 4) which tiles a
    patch lies on: before it along both, before it along y, along x, its own; any where that one is
    not made. enough: () False if n is too small.
    """

    corner: jax.Array
    present: jax.Array
    tile: jax.Array
    cell: jax.Array
    parts: jax.Array
    tiles: jax.Array
    enough: jax.Array


def box_of(options: PatchConfig, low, high, buckets) -> Box:
    """The bucketed box whose cores hold the pixels from `low` to before `high`; not jittable.

    Args:
      low, high: (2,) int y, x on the canvas. buckets: sides that a box may have, in patches.

    Raises:
      ValueError: more pixels than the largest bucket holds.
    """
    before = options.overlap - options.lead
    number = lambda at: (np.asarray(at, int) + before) // options.step  # noqa: E731
    first = number(low)
    need = int(np.max(number(np.asarray(high) - 1) - first)) + 1
    for side in sorted(buckets):
        if need <= side:
            return Box(first=jnp.asarray(first, jnp.int32), cells=(side, side))
    raise ValueError(
        f"a stroke over {need} patches along a side: expected at most {max(buckets)}, the largest "
        "of cells"
    )


def rect_of(low, high, margin: int, buckets) -> Rect | None:
    """The bucketed rectangle that holds the pixels from `low` to before `high` and `margin` more on
    each side, off the canvas, too: at its edges networks then see it go on, as in patches. None if
    it is larger than the buckets. Not jittable.

    Args:
      low, high: (2,) int y, x on the canvas. buckets: sides, rising [pixels].
    """
    # Networks tell pixels apart by their number modulo 4, so rectangles begin where patches may.
    low = (np.asarray(low, int) - margin) // 4 * 4
    high = np.asarray(high, int) + margin
    sides = [next((b for b in buckets if n <= b), None) for n in high - low]
    if None in sides:
        return None
    # About the middle, and it holds both ends.
    corner = np.maximum((low + high - sides) // 2 // 4 * 4, -(-(high - sides) // 4) * 4)
    return Rect(corner=jnp.asarray(corner, jnp.int32), sides=tuple(sides))


def patches_along(options: PatchConfig, low, high) -> int:
    """How many patches hold pixels of some rectangles in their cores; not jittable.

    Args:
      low, high: (t, 2) int, first pixel y, x of a rectangle and the one after its last.
    """
    before = options.overlap - options.lead
    spans = np.concatenate([low + before, high - 1 + before], axis=1) // options.step
    spans = np.unique(spans[np.all(high > low, axis=1)], axis=0)
    if not len(spans):
        return 0
    spans -= np.tile(spans[:, :2].min(0), 2)
    hit = np.zeros(spans[:, 2:].max(0) + 1, bool)
    for top, left, bottom, right in spans:
        hit[top : bottom + 1, left : right + 1] = True
    return int(hit.sum())


def corner_of(options: PatchConfig, box: Box | Rect):
    """(2,) first pixel y, x of a box on the canvas."""
    if isinstance(box, Rect):
        return box.corner
    return box.first * options.step - options.overlap


def grid_of(options: PatchConfig, box: Box | Rect, pixel: float) -> Grid:
    """The pixels of all patches of a box."""
    if isinstance(box, Rect):
        shape = box.sides
    else:
        shape = tuple(n * options.step + options.overlap for n in box.cells)
    return Grid(shape=shape, origin=corner_of(options, box)[::-1].astype(float) * pixel,
                pixel=pixel)  # fmt: skip


def _wanted(options, box, mask):
    """Which patches (rows, columns) and which tiles, one more each way, hold some of a mask."""
    (rows, columns), lead, step = box.cells, options.lead, options.step
    hit = mask > 0.0
    core = hit[lead : lead + rows * step, lead : lead + columns * step]
    tile = _tiled(options, box, hit)
    return jnp.any(core.reshape(rows, step, columns, step), axis=(1, 3)), jnp.any(tile, axis=(2, 3))


def _tiled(options, box, field):
    """A field (h, w, ...) of a box by tile, (rows + 1, columns + 1, step, step, ...)."""
    (rows, columns), step = box.cells, options.step
    before = step - options.overlap
    field = jnp.pad(field, [(before, 0)] * 2 + [(0, 0)] * (field.ndim - 2))
    field = field.reshape(rows + 1, step, columns + 1, step, *field.shape[2:])
    return jnp.swapaxes(field, 1, 2)


def needed(options: PatchConfig, box: Box, mask):
    """The least count of a Layout for a mask (h, w) of a box, () int."""
    patch, tile = (jnp.sum(w, dtype=jnp.int32) for w in _wanted(options, box, mask))
    return jnp.maximum(patch, (tile - 1) // 2)


def layout(options: PatchConfig, box: Box, mask, count: int) -> Layout:
    """Picks the patches and tiles that hold some of a mask.

    Args:
      mask: (h, w) of the box's grid, at least 0. count: static number n of patches.
    """
    patch, tile = _wanted(options, box, mask)
    step = options.step

    def pick(wanted, most):
        (index,) = jnp.nonzero(wanted.reshape(-1), size=most, fill_value=-1)
        index = index.astype(jnp.int32)
        columns = wanted.shape[1]
        held = jnp.maximum(index, 0)
        return index, jnp.stack([held // columns, held % columns], axis=1)

    index, place = pick(patch, count)
    slot = jnp.cumsum(patch.reshape(-1).astype(jnp.int32)) - 1
    slot = jnp.where(patch.reshape(-1) & (slot < count), slot, count).reshape(box.cells)
    slot = jnp.pad(slot, 1, constant_values=count)
    cell, at = pick(tile, 2 * count + 2)
    parts = jnp.stack(
        [slot[at[:, 0] + dy, at[:, 1] + dx] for dy in (0, 1) for dx in (0, 1)], axis=1
    )
    made = jnp.maximum(jnp.cumsum(tile.reshape(-1).astype(jnp.int32)) - 1, 0).reshape(tile.shape)
    under = jnp.stack(
        [made[place[:, 0] + dy, place[:, 1] + dx] for dy in (0, 1) for dx in (0, 1)], axis=1
    )
    there = cell[:, None] >= 0
    first = box.first[None]
    return Layout(
        corner=(first + place) * step - options.overlap,
        present=index >= 0,
        tile=jnp.where(there, (first + at - 1) * step, FAR),
        cell=jnp.maximum(cell, 0),
        parts=jnp.where(there, parts, count),
        tiles=jnp.minimum(under, 2 * count + 1),
        enough=needed(options, box, mask) <= count,
    )


def cut(options: PatchConfig, box: Box, field, corner):
    """Patches of a field of a box.

    Args:
      field: (h, w, c) on the box's grid. corner: (n, 2) from a Layout of the box.

    Returns:
      (n, size, size, c).
    """
    rows, columns = box.cells
    at = corner - corner_of(options, box)[None]
    # Clipped here: XLA's own clamping is wrong in some releases.
    y = jnp.clip(at[:, 0], 0, (rows - 1) * options.step)
    x = jnp.clip(at[:, 1], 0, (columns - 1) * options.step)
    size = (options.size, options.size, field.shape[2])
    return jax.vmap(lambda y, x: jax.lax.dynamic_slice(field, (y, x, 0), size))(y, x)


def pixels(corner, sides):
    """Rows (n, p, 1) and columns (n, 1, q) of rectangles of `sides` (p, q) at `corner` (n, 2)."""
    rows = corner[:, :1] + jnp.arange(sides[0], dtype=jnp.int32)[None]
    columns = corner[:, 1:] + jnp.arange(sides[1], dtype=jnp.int32)[None]
    return rows[:, :, None], columns[:, None, :]


def cut_canvas(field, corner, sides):
    """Rectangles of a field of the whole canvas, which goes on beyond its edges as it is there.

    Args:
      field: (h, w) or (h, w, c). corner: (n, 2) int y, x, anywhere. sides: (p, q) [pixels].

    Returns:
      (n, p, q) or (n, p, q, c).
    """
    rows, columns = pixels(corner, sides)
    return field[jnp.clip(rows, 0, field.shape[0] - 1), jnp.clip(columns, 0, field.shape[1] - 1)]


def cut_tiles(options: PatchConfig, box: Box, field, layout: Layout):
    """Tiles (m, step, step) of a field (h, w) of a box."""
    tiles = _tiled(options, box, field)
    return tiles.reshape(-1, options.step, options.step)[layout.cell]


def core(options: PatchConfig) -> np.ndarray:
    """(size, size, 1), 1 in the core of a patch: weights by which each pixel counts once."""
    inside = np.zeros(options.size, np.float32)
    inside[options.lead : options.lead + options.step] = 1.0
    return (inside[:, None] * inside[None])[..., None]


def ramps(options: PatchConfig, sharp: bool) -> tuple[np.ndarray, np.ndarray]:
    """Shares of patches i and i + 1 along tile i and one pixel more, (step + 1,) each."""
    alone = options.step - options.overlap
    k = np.arange(options.step + 1) - alone
    if sharp:
        own = (k < options.lead).astype(np.float32)
    else:
        # Of the pixels in between, as if the two beside the overlap were 1 and 0.
        own = 1.0 - np.clip(k + 1, 0, options.overlap + 1) / (options.overlap + 1)
    return own.astype(np.float32), (1.0 - own).astype(np.float32)


def parts_of(options: PatchConfig, patches, layout: Layout):
    """What four patches put into each tile, with one pixel more along y and x.

    Args:
      patches: (n, size, size, c).

    Returns:
      Four pairs of values (m, step + 1, step + 1, c) and where they are there (m, step + 1,
      step + 1, 1), 0 or 1.
    """
    step, over = options.step, options.overlap
    alone, count = step - over, patches.shape[0]
    # (first pixel of the patch, pixels of it, before, behind) along an axis
    own, following = (over, step, 0, 1), (0, over + 1, alone, 0)
    found = []
    for k, (y, x) in enumerate(((own, own), (own, following), (following, own), (following,) * 2)):
        number = layout.parts[:, k]
        picked = patches[:, y[0] : y[0] + y[1], x[0] : x[0] + x[1]]
        picked = picked[jnp.minimum(number, count - 1)]
        edge = ((0, 0), y[2:], x[2:], (0, 0))
        there = (number < count).astype(patches.dtype)[:, None, None, None]
        inside = np.pad(np.ones((1, y[1], x[1], 1), patches.dtype), edge)
        found.append((jnp.pad(picked * there, edge), there * inside))
    return found


def shares_of(options: PatchConfig, sharp: bool, dtype):
    """Four (1, step + 1, step + 1, 1), the shares of the parts by the ramps of both axes."""
    own, following = ramps(options, sharp)
    shares = [y[:, None] * x[None] for y in (own, following) for x in (own, following)]
    return [jnp.asarray(share, dtype)[None, :, :, None] for share in shares]


def weighted(parts, shares):
    """Mean of the parts of tiles by their shares; 0 where there is none."""
    total, weight = 0.0, 0.0
    for (value, there), share in zip(parts, shares, strict=True):
        total, weight = total + there * share * value, weight + there * share
    return total / jnp.where(weight > 0.0, weight, 1.0)


def merge(options: PatchConfig, patches, layout: Layout, sharp: bool = False):
    """The tiles that patches make together, (m, step, step, c).

    Args:
      patches: (n, size, size, c). sharp: each takes its core; else neighbours fade into each other
        over their overlap.
    """
    shares = shares_of(options, sharp, patches.dtype)
    return weighted(parts_of(options, patches, layout), shares)[:, :-1, :-1]


def recut(options: PatchConfig, tiles, layout: Layout):
    """Patches (n, size, size, c) of tiles (m, step, step, c); where there is no tile, what is in
    another."""
    alone = options.step - options.overlap
    piece = [tiles[layout.tiles[:, k]] for k in range(4)]
    above = jnp.concatenate([piece[0][:, alone:, alone:], piece[1][:, alone:]], axis=2)
    below = jnp.concatenate([piece[2][:, :, alone:], piece[3]], axis=2)
    return jnp.concatenate([above, below], axis=1)


def tile_of(layout: Layout | Rect):
    """(m, 2) first pixel of each tile."""
    return layout.corner[None] if isinstance(layout, Rect) else layout.tile


def place(tiles, layout: Layout | Rect, field, mask=None):
    """Lays tiles over a field of the whole canvas; what lies off it is dropped.

    Args:
      tiles: (m, step, step) or (m, step, step, c); of a Rect one, of its sides. field: (h, w) or
        (h, w, c). mask: (m, step, step) bool, what is laid; the rest of the field keeps its bits.
    """
    rows, columns = pixels(tile_of(layout), tiles.shape[1:3])
    # A negative index would count from the end.
    keep = (rows >= 0) & (columns >= 0) & (columns < field.shape[1])
    if mask is not None:
        keep = keep & mask
    rows = jnp.where(keep, rows, field.shape[0])
    return field.at[rows, jnp.maximum(columns, 0)].set(tiles, mode="drop")
