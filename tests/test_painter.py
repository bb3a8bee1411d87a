"""The painting system end to end: where it paints, in which sizes, early or late, and its slope."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbrush import batches, checkpoint, painter, patches, seams, stages
from jaxbrush.brush import BrushConfig, make_brush
from jaxbrush.canvas import Canvas, blank, to_srgb
from jaxbrush.metrics import image_scale
from jaxbrush.models import Generator, GeneratorConfig
from jaxbrush.stylus import make_stroke

OPTIONS = painter.PainterConfig(
    brush=BrushConfig(nodes=4, track_nodes=2, approach=2),
    patches=patches.PatchConfig(size=28, overlap=8), stamps=(32,), cells=(5,), batch=16,
    blend="feather", moments="patch",
)  # fmt: skip
BRUSH = make_brush(
    jax.random.key(0), OPTIONS.brush, "round", 16, width=1.0, length=5.0, press_depth=1.5
)
PAINT = (0.02, 0.1, 0.5)


def network(inputs, outputs, norm="instance", width=0.05, mixes=False):
    config = GeneratorConfig(outputs=outputs, width=width, norm=norm, mixes=mixes)
    shape = jax.eval_shape(
        Generator(config).init,
        jax.random.key(0),
        jnp.zeros((1, 4, 4, inputs)),
        jnp.ones((1, 4, 4, 1)),
    )
    rng = np.random.default_rng(inputs)
    # Larger than what training starts from: what is painted has contrast.
    draw = lambda x: jnp.asarray(rng.normal(0.0, 0.2, x.shape), jnp.float32)  # noqa: E731
    return checkpoint.Exported(jax.tree.map(draw, shape), config, {"made by": "a test"})


NETS = painter.make_nets(network(painter.HEIGHT_INPUTS, 1), network(painter.COLOR_INPUTS, 3))


LONG = jax.tree.map(np.asarray, make_stroke(np.zeros((80, 2)), pressure=0.6))


def canvas(h=64, w=64, seed=0):
    rng = np.random.default_rng(seed)
    draw = lambda *shape: jnp.asarray(rng.uniform(0.1, 0.9, shape), jnp.float32)  # noqa: E731
    return Canvas(height=draw(h, w), color=draw(h, w, 3))


def line(start, end, count=9):
    share = np.linspace(0.0, 1.0, max(count, 2))[:count, None]
    position = (1.0 - share) * np.asarray(start) + share * np.asarray(end)
    # By numpy: every length would compile anew.
    given = jax.tree.map(lambda x: x[:count], LONG)
    return dataclasses.replace(given, position=position.astype(np.float32))


def maps_of(stroke, shape=(64, 64), options=OPTIONS):
    track, bounds = painter._begin(options, BRUSH, stroke)
    box = painter.place(options, shape, bounds)
    drawn, _ = painter.draw_on(options, box, blank(shape), track, jnp.asarray(PAINT))
    return box, drawn, track, bounds


def mask_of(stroke, shape=(64, 64)):
    """Where the stroke is laid on the canvas."""
    box, drawn, *_ = maps_of(stroke, shape)
    y, x = np.asarray(patches.corner_of(OPTIONS.patches, box))
    full, mask = np.zeros(shape), np.asarray(drawn.share[..., 0])
    rows = slice(max(y, 0), min(y + mask.shape[0], shape[0]))
    columns = slice(max(x, 0), min(x + mask.shape[1], shape[1]))
    full[rows, columns] = mask[rows.start - y : rows.stop - y, columns.start - x : columns.stop - x]
    return full


def check_painted(found, before, stroke):
    mask = mask_of(stroke, before.height.shape) > 0.0
    for new, old in ((found.height, before.height), (found.color, before.color)):
        new, old = np.asarray(new), np.asarray(old)
        assert np.all(np.isfinite(new))
        np.testing.assert_array_equal(new[~mask], old[~mask])
        assert np.mean(new[mask] != old[mask]) > 0.99
    assert found.height.max() <= batches.LEVELS["height"] and found.color.max() <= 1.0
    return mask


PATHS = {
    "inside": ((3.0, 3.0), (5.0, 4.5)), "off the edge": ((3.0, 4.0), (3.2, -2.0)),
    "in the corner": ((8.1, 8.1), (7.5, 8.2)), "larger than the canvas": ((-1.0, 3.0), (9.0, 5.0)),
    "one sample": ((4.0, 4.0), (4.0, 4.0)),
}  # fmt: skip


@pytest.mark.parametrize("name", PATHS)
def test_only_the_mask_is_painted(name):
    before = canvas()
    stroke = line(*PATHS[name], 1 if name == "one sample" else 9)
    found = painter.paint_stroke(OPTIONS, NETS, before, BRUSH, PAINT, stroke)
    assert check_painted(found, before, stroke).any()


WHOLE = dataclasses.replace(OPTIONS, moments="stroke", blend="cut", sides=(80,))
_paint_on = jax.jit(painter.paint_on, static_argnums=(0, 1))


@pytest.mark.parametrize("name", PATHS)
def test_a_stroke_in_one_piece(name):
    before = canvas()
    stroke = jax.tree.map(jnp.asarray, line(*PATHS[name], 9))
    sizes, first = painter.plan(WHOLE, before, BRUSH, stroke)
    assert sizes.sides == (80, 80) and sizes.count == 0
    found = painter.paint_stroke(WHOLE, NETS, before, BRUSH, PAINT, stroke)
    assert check_painted(found, before, stroke).any()
    again, ok = _paint_on(WHOLE, sizes, NETS, before, BRUSH, jnp.asarray(PAINT), stroke, first)
    assert ok
    np.testing.assert_allclose(again.color, found.color, atol=2e-5)
    np.testing.assert_allclose(again.height, found.height, atol=2e-5)


def test_a_canvas_smaller_than_the_rectangle():
    before, stroke = canvas(20, 24), line((-0.5, 1.0), (2.0, 1.5))
    found = painter.paint_stroke(WHOLE, NETS, before, BRUSH, PAINT, stroke)
    assert check_painted(found, before, stroke).any()


def test_one_piece_where_it_is_less_work():
    """A long diagonal is cut into patches, and so is what no rectangle holds."""
    place = lambda stroke, shape, options: painter.place(  # noqa: E731
        options, shape, painter._begin(options, BRUSH, stroke)[1]
    )
    wide = dataclasses.replace(
        WHOLE, patches=patches.PatchConfig(48, 16), stamps=(512,), cells=(16,), sides=(96, 448)
    )
    straight, slanted = line((2.0, 9.0), (48.0, 9.0)), line((2.0, 2.0), (48.0, 48.0))
    assert place(straight, (400, 400), wide).sides == (96, 448)
    assert isinstance(place(slanted, (400, 400), wide), patches.Box)
    few = dataclasses.replace(wide, sides=(96, 128))
    assert isinstance(place(straight, (400, 400), few), patches.Box)


def test_a_stroke_fades_out_within_its_rim():
    cover = np.zeros((24, 24), np.float32)
    cover[10:13, 9:12] = 1.0
    share, grown = stages.faded(jnp.asarray(cover))
    np.testing.assert_allclose(share[11, 11:18], [1.0, 1.0, 0.75, 0.5, 0.25, 0.0, 0.0], atol=1e-6)
    assert float(share.max()) <= 1.0 and stages.RIM == 4
    np.testing.assert_array_equal(np.asarray(grown) > 0.0, np.asarray(share) > 0.0)


def test_the_stroke_counts_no_more_than_in_training():
    rng = np.random.default_rng(0)
    for share in (0.0, 0.1, 0.6, 1.0):
        mask = jnp.asarray(rng.uniform(size=(1, 40, 40, 1)) < share, jnp.float32)
        weights = np.asarray(stages.balanced(mask))
        assert np.all(np.isfinite(weights)) and weights.min() >= 0.0 and weights.max() > 0.0
        counts = float(np.sum(weights * np.asarray(mask)) / weights.sum())
        want = min(float(mask.mean()), stages.SHARE) if share < 1.0 else 1.0
        assert counts == pytest.approx(want, abs=1e-4)


def test_strokes_that_touch_nothing_change_nothing():
    before = canvas()
    for stroke in (line((-30.0, -30.0), (-29.0, -29.0)), line((3.0, 3.0), (4.0, 4.0))):
        if stroke.position[0, 0] > 0.0:
            stroke = dataclasses.replace(stroke, valid=np.zeros_like(stroke.valid))
        found = painter.paint_stroke(OPTIONS, NETS, before, BRUSH, PAINT, stroke)
        np.testing.assert_array_equal(found.color, before.color)
        np.testing.assert_array_equal(found.height, before.height)
    assert painter.plan(OPTIONS, before, BRUSH, stroke) is None


def test_canvases_of_any_size():
    """The lattice is the canvas's: where the canvas ends moves no patch."""
    large, stroke = canvas(90, 75), line((1.0, 1.0), (1.7, 1.5))
    found = painter.paint_stroke(OPTIONS, NETS, large, BRUSH, PAINT, stroke)
    check_painted(found, large, stroke)
    small = Canvas(height=large.height[:64, :64], color=large.color[:64, :64])
    again = painter.paint_stroke(OPTIONS, NETS, small, BRUSH, PAINT, stroke)
    np.testing.assert_allclose(again.color, found.color[:64, :64], atol=1e-5)
    np.testing.assert_allclose(again.height, found.height[:64, :64], atol=1e-5)
    tiny = canvas(16, 16)
    found = painter.paint_stroke(OPTIONS, NETS, tiny, BRUSH, PAINT, stroke)
    check_painted(found, tiny, stroke)


@pytest.mark.slow
def test_the_largest_canvas():
    """4096 pixels a side, a stroke in the middle and one off its last corner; the rest is left."""
    options = dataclasses.replace(OPTIONS, moments="stroke", blend="cut", sides=(64,))
    before, side = canvas(4096, 4096), 4096 * options.pixel
    for x, y in ((0.5 * side, 0.5 * side), (side - 2.0, side - 1.0)):
        stroke = line((x, y), (x + 3.0, y + 2.0))
        after = painter.paint_stroke(options, NETS, before, BRUSH, PAINT, stroke)
        changed = np.any(np.asarray(after.color != before.color), axis=-1)
        rows, columns = np.nonzero(changed)
        assert changed.sum() > 100 and np.all(np.isfinite(np.asarray(after.color)))
        at = np.asarray([columns, rows]) * options.pixel - np.asarray([[x], [y]])
        assert at.min() > -5.0 and at.max() < 8.0


def test_the_maps_tell_what_the_brush_holds_and_how_large_it_is():
    """Four times the bristles in one ferrule sweep a pixel four times as often, and each lays a
    quarter; a brush of four times the area lays more than its sweeps say."""

    def drawn_by(width, bristles, load):
        brush = make_brush(jax.random.key(1), OPTIONS.brush, "flat", bristles, width=width,
                           thickness=0.5 * width, length=5.0, press_depth=1.5)  # fmt: skip
        stroke = line(*PATHS["inside"])
        track, bounds = painter._begin(OPTIONS, brush, stroke, load)
        box = painter.place(OPTIONS, (64, 64), bounds)
        return painter.draw_on(OPTIONS, box, blank((64, 64)), track, jnp.asarray(PAINT))[0], track

    (few, a), (many, b), (large, c) = (
        drawn_by(*x) for x in ((1.0, 16, 0.3), (1.0, 64, 0.9), (2.0, 64, 0.9))
    )
    hairs = [float(track.hairs[0]) for track in (a, b, c)]
    assert hairs[0] == pytest.approx(4.0 * hairs[1]) and hairs[2] == pytest.approx(hairs[0])
    assert hairs[1] == pytest.approx(0.5 / 64 / (6.3 / 260))
    laid = [float(d.sweeps.sum()) for d in (few, many)]
    assert laid[1] == pytest.approx(laid[0], rel=0.15)
    assert laid[1] / hairs[1] > 3.0 * laid[0] / hairs[0]
    for drawn, load in ((few, 0.3), (many, 0.9)):
        came = np.asarray(drawn.sweeps) > 0.0
        np.testing.assert_allclose(np.asarray(drawn.load)[came], load, rtol=1e-6)
        assert np.all(np.asarray(drawn.load)[~came] == 0.0)


def test_networks_see_what_they_were_trained_on():
    """One patch by hand, from the dictionary that a data set gives."""
    box, drawn, *_ = maps_of(line(*PATHS["inside"]))
    before = canvas()
    layout, pair = painter._cut(OPTIONS, box, drawn, before, count=16)
    found = painter._evaluate(OPTIONS, NETS, pair)[:1]
    pair = {name: np.asarray(x[:1]) for name, x in pair.items()}
    y, x = np.asarray(layout.corner[0])
    rows, columns = (np.clip(np.arange(at, at + 28), 0, 63) for at in (y, x))
    np.testing.assert_allclose(pair["color"][0], to_srgb(before.color)[rows][:, columns], atol=1e-6)
    assert pair["trajectory"].max(axis=(0, 1, 2)) == pytest.approx(
        np.asarray(to_srgb(jnp.asarray(PAINT))), abs=1e-6
    )
    zero = np.zeros_like(pair["height"])
    assert pair["sweeps"].max() >= 1.0
    pair |= {"new_height": zero, "new_color": pair["color"]}

    @jax.jit
    def by_hand(pair):
        run = lambda net, x: image_scale(  # noqa: E731
            Generator(net.config).apply(net.variables, x)
        )
        height = run(network(painter.HEIGHT_INPUTS, 1), batches.height_batch(pair).inputs)
        new = batches.LEVELS["height"] * height - pair["height"]
        new = pair["height"] + pair["share"] * new
        color = run(network(8, 3), batches.color_batch(pair | {"new_height": new}).inputs)
        return jnp.concatenate([height, color], axis=-1)

    np.testing.assert_allclose(found, by_hand(pair), atol=1e-5)


SOFT = dataclasses.replace(OPTIONS, edge=0.25, stamps=(16,), cells=(2,))


def test_the_pure_function_is_the_driver(monkeypatch):
    """And has a slope, here by the color of the paint."""
    before, stroke = canvas(), jax.tree.map(jnp.asarray, line(*PATHS["inside"]))
    sizes, first = painter.plan(OPTIONS, before, BRUSH, stroke)
    way = jnp.asarray([0.5, 1.0, 0.7])  # along which slopes do not cancel
    weight = jnp.asarray(np.random.default_rng(1).normal(size=(64, 64)), jnp.float32)

    def error(shift):
        after, ok = painter.paint_on(
            OPTIONS, sizes, NETS, before, BRUSH, jnp.asarray(PAINT) + shift * way, stroke, first
        )
        return jnp.where(ok, jnp.sum(weight * (after.height + after.color[..., 0])), jnp.nan), after

    # Compiled as a whole, rounding moves single bristles by a step of `on_steps`, which networks
    # would show (8e-5 mm): the places are compared to a step, what is painted on the same ones.
    track = painter._begin(OPTIONS, BRUSH, stroke)[0]
    assert track.time.shape[0] == sizes.stamps
    own = jax.jit(lambda s: stages.trace(
        OPTIONS, BRUSH, stages.place_stamps(OPTIONS, BRUSH, s, sizes.stamps)
    ))(stroke)  # fmt: skip
    step = OPTIONS.pixel / stages.STEPS
    np.testing.assert_allclose(own.position, track.position, atol=1.01 * step)
    monkeypatch.setattr(stages, "trace", lambda *_: track)
    error = jax.jit(jax.value_and_grad(error, has_aux=True))
    (_, found), _ = error(jnp.zeros(()))
    # Networks have kinks: a difference is the mean of the slopes between.
    step, places = 2.5e-4, 32
    between = step * (2.0 * (np.arange(places) + 0.5) / places - 1.0)
    slopes = np.asarray([error(jnp.asarray(x, jnp.float32))[1] for x in between])
    ahead, behind = (error(jnp.asarray(x, jnp.float32))[0][0] for x in (step, -step))
    assert np.all(np.isfinite(slopes)) and np.all(np.abs(slopes) > 0.1)
    np.testing.assert_allclose((ahead - behind) / (2.0 * step), slopes.mean(), rtol=0.05)
    want = painter.paint_stroke(OPTIONS, NETS, before, BRUSH, PAINT, stroke)
    np.testing.assert_allclose(found.color, want.color, atol=2e-5)
    np.testing.assert_allclose(found.height, want.height, atol=2e-5)


def test_networks_are_told_of_the_weave():
    stroke = line(*PATHS["inside"])
    films = []
    for relief in (0.0, 0.09):
        options = dataclasses.replace(OPTIONS, relief=relief)
        track, bounds = painter._begin(options, BRUSH, stroke, 0.2)
        box = painter.place(options, canvas().height.shape, bounds)
        drawn, _ = painter.draw_on(options, box, canvas(), track, jnp.asarray(PAINT))
        films.append(np.asarray(drawn.film))
    assert np.abs(films[0] - films[1]).max() > 1e-3
    with pytest.raises(ValueError, match="PainterConfig.relief = -0.1"):
        dataclasses.replace(OPTIONS, relief=-0.1)


@pytest.mark.slow
def test_slope_from_canvas_to_stylus():
    """All the way, by the place of the samples. Soft maps jump where bristles of a stamp change
    their order, so steps are short, and one jump in three places is let pass."""
    before, given = canvas(), line((3.0, 3.0), (4.2, 3.5))
    given.position[:, 1] += 0.3 * np.sin(np.linspace(0.0, 3.0, 9)).astype(np.float32)
    stroke = jax.tree.map(jnp.asarray, given)
    sizes = stages.Sizes(stamps=16, cells=(2, 2), count=4)
    way = jnp.asarray(np.random.default_rng(0).normal(size=stroke.position.shape), jnp.float32)
    row = jnp.arange(64.0)
    weight = jnp.sin(0.2 * row)[:, None] * jnp.cos(0.15 * row)[None]

    @jax.jit
    @jax.value_and_grad
    def error(shift):
        moved = dataclasses.replace(stroke, position=stroke.position + shift * way)
        after, ok = painter.paint_on(SOFT, sizes, NETS, before, BRUSH, jnp.asarray(PAINT), moved,
                                     jnp.asarray([0, 0], jnp.int32))  # fmt: skip
        return jnp.where(ok, jnp.sum(weight * (after.height + after.color[..., 0])), jnp.nan)

    off, step = [], 2e-4
    for shift in (0.0, 0.004, -0.013):
        slope = error(jnp.asarray(shift))[1]
        ahead, behind = (error(jnp.asarray(shift + sign * step))[0] for sign in (1.0, -1.0))
        off.append(float(abs((ahead - behind) / (2.0 * step) / slope - 1.0)))
    assert np.all(np.isfinite(off)) and np.median(off) < 0.1, off


def test_moments_of_the_whole_stroke_leave_no_seam():
    """Without any blend, once the overlap holds what a network sees; each patch by its own moments
    leaves some."""
    options = dataclasses.replace(
        OPTIONS, patches=patches.PatchConfig(96, 40), cells=(2,), blend="cut", moments="stroke"
    )
    rng = np.random.default_rng(0)
    side = 2 * 56 + 40
    box = patches.Box(first=jnp.asarray([0, 0], jnp.int32), cells=(2, 2))
    draw = lambda n: jnp.asarray(rng.uniform(0.0, 1.0, (side, side, n)), jnp.float32)  # noqa: E731
    mask = np.zeros((side, side, 1), np.float32)
    mask[44:125, 44:125] = 1.0
    shade = jnp.linspace(0.1, 2.0, side)[:, None, None] * jnp.asarray(mask)
    drawn = stages.Drawn(
        pressure=draw(1) * shade, sweeps=9.0 * draw(1) * shade, time=draw(1) * shade,
        trajectory=draw(3) * jnp.asarray(mask), load=0.8 * jnp.asarray(mask),
        tip=0.1 * draw(1), film=0.3 * draw(1), hair=0.1 * draw(1), lift=draw(1), picked=draw(3),
        mask=jnp.asarray(mask), share=jnp.asarray(mask), whole=jnp.asarray(True),
    )  # fmt: skip

    @functools.partial(jax.jit, static_argnames="moments")
    def seam(moments):
        own = dataclasses.replace(options, moments=moments)
        layout = patches.layout(own.patches, box, drawn.mask[..., 0], 4)
        pairs = stages.cut(own, box, drawn, canvas(90, 90), layout)
        painted = stages.evaluate(own, NETS, pairs, layout)
        found = patches.place(stages.blend(own, painted, layout), layout, jnp.zeros((90, 90, 4)))
        held = drawn.mask[40:130, 40:130, 0]
        return jnp.max(seams.seam(own.patches, painted, layout, found, held))

    whole, apart = float(seam("stroke")), float(seam("patch"))
    print("seam:", whole, apart)
    assert whole < 0.1 / 255.0 < 2.0 / 255.0 < apart


@pytest.mark.parametrize("strokes", [40, pytest.param(200, marks=pytest.mark.slow)])
def test_a_session_compiles_a_bounded_number_of_times(strokes):
    names = ("_trace", "draw_on", "_evaluate", "_cut", "_lay_over")
    stages_run = [getattr(painter, name) for name in names]
    before = [f._cache_size() for f in stages_run]
    now, rng = canvas(), np.random.default_rng(0)
    for k in range(strokes):
        length = (0.0, 0.5, 1.0, 8.0)[k % 4]
        start, turn = rng.uniform(0.0, 8.0, 2), rng.uniform(0.0, 6.28)
        end = start + length * np.array([np.cos(turn), np.sin(turn)])
        now = painter.paint_stroke(
            OPTIONS, NETS, now, BRUSH, PAINT, line(start, end, 1 + k % 60), donate=True
        )
    compiled = [f._cache_size() - a for f, a in zip(stages_run, before, strict=True)]
    print("compiled", compiled)
    # One bucket of stamps, one box; 16, 24 or 32 patches.
    assert np.all(np.array(compiled) <= [1, 1, 1, 3, 3])
    assert np.all(np.isfinite(now.color)) and np.all(np.isfinite(now.height))


def test_the_preview_is_that_of_the_maps():
    before, stroke = canvas(), line(*PATHS["off the edge"])
    found = painter.preview_stroke(OPTIONS, before, BRUSH, PAINT, stroke)
    changed = np.any(np.asarray(found.color) != np.asarray(before.color), axis=-1)
    assert 0.0 < changed.sum() < (mask_of(stroke) > 0.0).sum()
    assert np.all(mask_of(stroke)[changed] > 0.0)
    np.testing.assert_allclose(np.asarray(found.color)[changed], [PAINT] * changed.sum(), atol=1e-6)
    assert np.all(np.asarray(found.height)[changed] >= batches.PREVIEW_FILM - 1e-6)
    np.testing.assert_array_equal(
        np.asarray(found.height)[~changed], np.asarray(before.height)[~changed]
    )


def test_arguments_are_checked(tmp_path):
    with pytest.raises(ValueError, match="color network has 7 inputs"):
        painter.make_nets(network(painter.HEIGHT_INPUTS, 1), network(7, 3))
    for name, net in (
        ("h", network(painter.HEIGHT_INPUTS, 1)),
        ("c", network(painter.COLOR_INPUTS, 3)),
    ):
        checkpoint.export(tmp_path / f"{name}.npz", net.config, net.variables, net.card)
    nets = painter.load_nets(tmp_path / "h.npz", tmp_path / "c.npz")
    assert nets.color_config.outputs == 3
    with pytest.raises(ValueError, match="PainterConfig.blend = 'none'"):
        dataclasses.replace(OPTIONS, blend="none")
    with pytest.raises(ValueError, match="PainterConfig.cells"):
        dataclasses.replace(OPTIONS, cells=(4, 2))
    with pytest.raises(ValueError, match="PainterConfig.sides"):
        dataclasses.replace(OPTIONS, sides=(64, 30))
    for load in (0.0, 1.5, np.nan):
        with pytest.raises(ValueError, match="load = "):
            painter.paint_stroke(
                OPTIONS, NETS, canvas(), BRUSH, PAINT, line(*PATHS["inside"]), load=load
            )
    wrong = dataclasses.replace(canvas(), height=jnp.zeros((8, 8)))
    with pytest.raises(ValueError, match="canvas of height"):
        painter.paint_stroke(OPTIONS, NETS, wrong, BRUSH, PAINT, line(*PATHS["inside"]))
    broken = make_stroke([[np.nan, 1.0], [2.0, 2.0]])
    with pytest.raises(ValueError, match="not finite"):
        painter.paint_stroke(OPTIONS, NETS, canvas(), BRUSH, PAINT, broken)
    with pytest.raises(ValueError, match="expected at most 5"):
        painter.paint_stroke(OPTIONS, NETS, canvas(200, 200), BRUSH, PAINT,
                             line((1.0, 1.0), (22.0, 22.0)))  # fmt: skip
