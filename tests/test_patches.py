"""The lattice of patches: what is cut where, and that patches agree with one whole picture."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbrush import patches, seams
from jaxbrush.models import Generator, GeneratorConfig

OPTIONS = patches.PatchConfig(size=28, overlap=8)
STEP, OVER, LEAD = OPTIONS.step, OPTIONS.overlap, OPTIONS.lead
CELLS = (3, 4)
SHAPE = tuple(n * STEP + OVER for n in CELLS)
COUNT = 16
pick = jax.jit(patches.layout, static_argnums=3)
cut = jax.jit(patches.cut)
place = jax.jit(patches.place)


def box_at(y, x, cells=CELLS):
    return patches.Box(first=jnp.asarray([y, x], jnp.int32), cells=cells)


def blob(seed=0, shape=SHAPE):
    """A mask as of a stroke, clear of the rim of the box."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]]
    middle = rng.uniform(0.3, 0.7, 2) * shape
    slope = rng.uniform(-1.0, 1.0)
    mask = np.abs((y - middle[0]) - slope * (x - middle[1])) < 6.0
    mask[:LEAD], mask[LEAD - OVER :], mask[:, :LEAD], mask[:, LEAD - OVER :] = (False,) * 4
    return jnp.asarray(mask, jnp.float32)


@pytest.mark.parametrize("first", [(0, 0), (2, -3)])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_every_masked_pixel_is_deep_inside_a_patch(seed, first):
    box, mask = box_at(*first), blob(seed)
    layout = pick(OPTIONS, box, mask, COUNT)
    assert layout.enough and int(layout.present.sum()) < CELLS[0] * CELLS[1]
    origin = np.asarray(patches.corner_of(OPTIONS, box))
    np.testing.assert_array_equal(origin, np.array(first) * STEP - OVER)
    deep = np.zeros(SHAPE, bool)
    for corner in np.asarray(layout.corner)[np.asarray(layout.present)]:
        assert np.all((corner + OVER) % STEP == 0)
        y, x = corner - origin + LEAD
        here = (slice(y, y + STEP), slice(x, x + STEP))
        assert mask[here].any()
        deep[here] = True
    assert np.all(deep[np.asarray(mask) > 0.0])
    assert int(jax.jit(patches.needed)(OPTIONS, box, mask)) <= COUNT
    assert not pick(OPTIONS, box, mask, 2).enough


def test_cut_and_merge_give_the_picture_back():
    """What is off the canvas is cut as its edge, and dropped again."""
    rng = np.random.default_rng(0)
    # The canvas has no room for the first row of patches, nor for the last column.
    canvas = jnp.asarray(rng.normal(size=(50, 70, 3)), jnp.float32)
    box, mask = box_at(0, 0), np.zeros(SHAPE, np.float32)
    mask[OVER : OVER + 50, OVER : OVER + 66] = 1.0
    layout = pick(OPTIONS, box, jnp.asarray(mask), COUNT)
    given = jax.jit(patches.cut_canvas, static_argnums=2)(
        canvas, layout.corner, (OPTIONS.size,) * 2
    )
    k = 5
    y, x = np.asarray(layout.corner[k])
    rows, columns = np.clip(np.arange(y, y + 28), 0, 49), np.clip(np.arange(x, x + 28), 0, 69)
    np.testing.assert_array_equal(given[k], canvas[rows][:, columns])
    for sharp in (False, True):
        tiles = jax.jit(patches.merge, static_argnums=3)(OPTIONS, given, layout, sharp)
        held = patches.cut_tiles(OPTIONS, box, jnp.asarray(mask), layout) > 0.0
        found = place(tiles, layout, jnp.zeros_like(canvas), held)
        inside = mask[OVER : OVER + 50, OVER : OVER + 70] > 0.0
        np.testing.assert_allclose(found[inside], canvas[inside], atol=1e-6)
        np.testing.assert_array_equal(np.asarray(found)[~inside], 0.0)


def test_a_patch_is_the_part_of_a_field_below_it():
    box = box_at(-1, 2)
    field = jnp.arange(SHAPE[0] * SHAPE[1], dtype=jnp.float32).reshape(*SHAPE, 1)
    layout = pick(OPTIONS, box, jnp.ones(SHAPE), COUNT)
    found = cut(OPTIONS, box, field, layout.corner)
    for k in range(12):
        y, x = np.asarray(layout.corner[k] - patches.corner_of(OPTIONS, box))
        np.testing.assert_array_equal(found[k], field[y : y + 28, x : x + 28])


def test_recut_is_the_inverse_of_merge():
    box, field = box_at(1, 0), np.random.default_rng(0).normal(size=(*SHAPE, 2))
    layout = pick(OPTIONS, box, jnp.ones(SHAPE), COUNT)
    given = cut(OPTIONS, box, jnp.asarray(field, jnp.float32), layout.corner)
    again = lambda x: patches.recut(OPTIONS, patches.merge(OPTIONS, x, layout), layout)  # noqa: E731
    np.testing.assert_allclose(jax.jit(again)(given)[:12], given[:12], atol=1e-6)


@pytest.mark.parametrize("low, high, side", [
    ((0, 0), (1, 1), 1), ((15, 15), (17, 17), 2), ((-9, 0), (-4, 3), 1),
    ((-9, 0), (-3, 3), 2), ((3, 3), (16, 40), 4),
])  # fmt: skip
def test_boxes_come_in_buckets(low, high, side):
    box = patches.box_of(OPTIONS, low, high, (1, 2, 4))
    assert box.cells == (side, side)
    core = np.asarray(box.first) * STEP - OVER + LEAD
    assert np.all(core <= low) and np.all(core + side * STEP >= high)
    assert np.all(core + STEP > low)


def test_boxes_and_sizes_are_checked():
    with pytest.raises(ValueError, match="expected at most 2"):
        patches.box_of(OPTIONS, (0, 0), (80, 5), (1, 2))
    for size, overlap in ((30, 8), (16, 8), (40, 12), (40, 0)):
        with pytest.raises(ValueError, match="expected a multiple"):
            patches.PatchConfig(size, overlap)


@pytest.mark.parametrize("norm", ["none", "instance"])
def test_patches_against_the_whole(norm):
    """Patches by their own moments show seams; by the moments of all, each pixel counted once, they
    agree with one evaluation of the whole box, once the overlap holds the 39 pixels a network
    sees."""
    config = GeneratorConfig(outputs=1, width=0.08, norm=norm)
    generator, cells = Generator(config), (2, 2)
    options = patches.PatchConfig(size=96, overlap=40)
    side = 2 * options.step + options.overlap
    rng = np.random.default_rng(0)
    field = rng.normal(size=(side, side, 2)).astype(np.float32)
    # Contrast differs from patch to patch, as strokes do.
    field *= np.linspace(0.2, 1.0, side, dtype=np.float32)[None, :, None]
    shapes = jax.eval_shape(generator.init, jax.random.key(0), field[None])
    variables = jax.tree.map(
        lambda x: jnp.asarray(rng.normal(0.0, 0.08, x.shape), jnp.float32), shapes
    )
    inside = slice(options.lead, options.lead + 2 * options.step)
    mask = np.zeros((side, side), np.float32)
    mask[inside, inside] = 1.0
    box = patches.Box(first=jnp.asarray([0, 0], jnp.int32), cells=cells)

    @jax.jit
    def run(variables, x):
        layout = patches.layout(options, box, jnp.asarray(mask), 4)
        given = patches.cut(options, box, x, layout.corner)
        share = jnp.broadcast_to(patches.core(options)[None], (4, 96, 96, 1))
        apart = generator.apply(variables, given)
        together = generator.apply(variables, given, share, pooled=True)
        whole = generator.apply(variables, x[None], jnp.asarray(mask)[None, ..., None])[0]
        result = []
        for painted in (apart, together):
            tiles = patches.merge(options, painted, layout, sharp=True)
            found = patches.place(tiles, layout, jnp.zeros((112, 112, 1)))
            at = options.overlap
            held = jnp.asarray(mask)[at:, at:]
            seam = seams.seam(options, painted, layout, found, held)
            off = held * jnp.abs(found[..., 0] - whole[at:, at:, 0])
            result.append((jnp.max(seam), jnp.max(off)))
        return result

    (seam, off), (pooled_seam, pooled_off) = run(variables, jnp.asarray(field))
    print(
        norm, "seam, off the whole:", float(seam), float(off), float(pooled_seam), float(pooled_off)
    )
    assert pooled_seam < 1e-4 and pooled_off < 1e-4
    if norm == "none":
        assert seam < 1e-4 and off < 1e-4
    else:
        assert seam > 2.0 / 255.0


def test_rectangles_hold_their_stroke_and_its_margin():
    rng = np.random.default_rng(1)
    buckets = (16, 24, 32, 48, 64)
    for _ in range(200):
        ends = np.sort(rng.integers(0, rng.integers(8, 80, 2), (2, 2)), axis=0)
        low, high = ends[0], ends[1] + 1
        rect = patches.rect_of(low, high, 4, buckets)
        if rect is None:
            assert np.max(high + 4 - (low - 4) // 4 * 4) > buckets[-1]
            continue
        corner, sides = np.asarray(rect.corner), np.asarray(rect.sides)
        assert np.all(np.isin(sides, buckets))
        assert np.all(corner <= low - 4) and np.all(corner + sides >= high + 4)
        assert np.all(corner % 4 == 0)
        # About its middle.
        assert np.all(np.abs(2 * corner + sides - low - high) <= 12)


def test_patches_are_counted_from_where_the_brush_goes():
    """As many as the layout wants of a mask of the same rectangles."""
    rng = np.random.default_rng(2)
    box = box_at(0, 0)
    origin = np.asarray(patches.corner_of(OPTIONS, box))
    cores = OPTIONS.step * np.asarray(box.cells)
    for _ in range(20):
        low = origin + OPTIONS.lead + rng.integers(0, cores - 12, (5, 2))
        high = low + rng.integers(-2, 12, (5, 2))
        mask = np.zeros(SHAPE, np.float32)
        for (y, x), (bottom, right) in zip(low - origin, high - origin, strict=True):
            if bottom > y and right > x:
                mask[y:bottom, x:right] = 1.0
        wanted, _ = patches._wanted(OPTIONS, box, jnp.asarray(mask))
        assert patches.patches_along(OPTIONS, low, high) == int(wanted.sum())
