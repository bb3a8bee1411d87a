"""Strokes painted patch by patch while they go on: the same picture as after the pen is lifted."""

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbrush import painter, patches, stream
from jaxbrush.brush import BrushConfig, make_brush
from jaxbrush.canvas import Canvas
from jaxbrush.models import Generator, GeneratorConfig
from jaxbrush.pen import FIELDS, Pen, checked
from jaxbrush.session import Session

OPTIONS = painter.PainterConfig(
    brush=BrushConfig(nodes=4, track_nodes=2, approach=2), stamps=(1024,), sides=(64,),
    relief=0.09,
)  # fmt: skip
SHAPE = (230, 330)
PAINT = np.asarray((0.1, 0.02, 0.5), np.float32)


def nets(norm):
    rng = np.random.default_rng(0)

    def one(inputs, outputs):
        config = GeneratorConfig(outputs, 0.05, norm, mixes=outputs == 3)
        shapes = jax.eval_shape(
            Generator(config).init, jax.random.key(0), jnp.zeros((1, 4, 4, inputs))
        )
        # Larger than what training starts from: what is painted has contrast.
        draw = lambda x: jnp.asarray(rng.normal(0.0, 0.15, x.shape), jnp.float32)  # noqa: E731
        return jax.tree.map(draw, shapes), config

    (height, height_config), (color, color_config) = (
        one(painter.HEIGHT_INPUTS, 1),
        one(painter.MIXED_INPUTS, 3),
    )
    return painter.Nets(height, color, height_config, color_config)


NETS = nets("none")


@pytest.fixture(scope="module")
def brush():
    return make_brush(
        jax.random.key(0), OPTIONS.brush, "round", 16, width=1.0, length=5.0, press_depth=1.5
    )


@pytest.fixture(scope="module")
def before():
    rng = np.random.default_rng(1)
    draw = lambda *shape: jnp.asarray(rng.uniform(0.1, 0.9, shape), jnp.float32)  # noqa: E731
    return Canvas(height=0.3 * draw(*SHAPE), color=draw(*SHAPE, 3))


def hand(kind):
    """Samples of a stroke over the canvas, to and fro over its first patches, or off its edge."""
    u = np.linspace(0.0, 1.0, 80)
    x = {"over": 3.0 + 35.0 * u, "back": 20.0 - 17.0 * np.cos(6.0 * u), "off": 25.0 + 25.0 * u}
    y = 12.0 + 8.0 * np.sin(4.0 * u) + (8.0 * u if kind == "back" else 0.0)
    press = 0.6 * np.minimum(1.0, np.minimum(u, 1.0 - u) * 20.0)
    return dict(zip(FIELDS, (u, x[kind], y, press, None, None, None), strict=True))


def pieces(brush, samples, options=OPTIONS):
    pen = Pen(options, brush)
    pen.add(checked(pen, samples))
    found = list(pen.advance())
    assert [final for _, _, final in found] == [True] * (len(found) - 1) + [False]
    return [(track, bounds) for track, bounds, _ in found]


def off(a: Canvas, b: Canvas) -> float:
    return max(
        float(jnp.abs(x - y).max()) / level
        for x, y, level in ((a.height, b.height, 1.25), (a.color, b.color, 1.0))
    )


@pytest.mark.parametrize("kind", ["over", "back", "off"])
def test_what_is_painted_early_is_what_is_painted_late(brush, before, kind):
    begun = stream.Stream(OPTIONS, NETS, before, PAINT)
    early, again = [], 0
    for piece in pieces(brush, hand(kind)):
        begun.add(*piece)
        for cell in begun.left():
            again += cell in early
            early.append(cell)
            (y, x), part = begun.paint(cell)
            h, w = part.height.shape
            assert 0 <= y <= y + h <= SHAPE[0] and 0 <= x <= x + w <= SHAPE[1]
    late = set(begun.left(end=True))
    assert early and (late or kind == "off")
    # A brush that comes back makes a patch anew; one that goes on does not.
    assert (again + len(late & set(early)) > 0) == (kind == "back")
    found = begun.result()
    assert np.all(begun.track().relief == np.float32(OPTIONS.relief))
    after = painter.paint_track(OPTIONS, NETS, before, begun.track(), begun.bounds, PAINT)
    changed = np.asarray(after.height != before.height)
    assert changed.sum() > 2000
    assert np.array_equal(changed, np.asarray(found.height != before.height))
    assert off(found, after) < 0.01 / 255.0


def test_one_piece_patches_and_stream_paint_the_same(brush, before):
    """Networks that see what is near alone; with moments of their picture they do not."""
    found = {}
    for norm, networks in (("none", NETS), ("instance", nets("instance"))):
        assert stream.local(networks) == (norm == "none")
        begun = stream.Stream(OPTIONS, networks, before, PAINT)
        for piece in pieces(brush, hand("over")):
            begun.add(*piece)
        track = begun.track(), begun.bounds
        ways = [begun.result()] + [
            painter.paint_track(
                dataclasses.replace(OPTIONS, sides=sides), networks, before, *track, PAINT
            )
            for sides in ((64,), (64, 512))
        ]
        found[norm] = max(off(ways[0], w) for w in ways[1:])
    print(found)
    assert found["none"] < 0.01 / 255.0 and found["instance"] > 2.0 / 255.0


def test_one_piece_and_patches_see_the_edge_of_the_canvas_alike(brush, before, monkeypatch):
    """Both go on beyond it. A rectangle that ends with the canvas, where the networks' convolutions
    are padded, is off by more than 2/255."""
    begun = stream.Stream(OPTIONS, NETS, before, PAINT)
    for piece in pieces(brush, hand("off")):
        begun.add(*piece)
    monkeypatch.setattr(painter, "MARGIN", 40)  # as far as the networks see
    paint = lambda sides: painter.paint_track(  # noqa: E731
        dataclasses.replace(OPTIONS, sides=sides), NETS, before, begun.track(), begun.bounds, PAINT
    )
    in_patches, rect = paint((64,)), patches.rect_of
    assert off(paint((64, 256)), in_patches) < 0.01 / 255.0
    inside = lambda *args: dataclasses.replace(rect(*args), corner=jnp.asarray([-12, 72]))  # noqa: E731
    monkeypatch.setattr(patches, "rect_of", inside)
    assert off(paint((64, 256)), in_patches) > 2.0 / 255.0


def test_patches_that_lay_their_own_film_miss_what_comes_from_beyond(brush, before, monkeypatch):
    """Hair takes paint along, so the film of a patch depends on where the hair was."""
    every = pieces(brush, hand("over"))

    def painted():
        begun = stream.Stream(OPTIONS, NETS, before, PAINT)
        for piece in every:
            begun.add(*piece)
        track = begun.track(), begun.bounds
        whole = painter.paint_track(OPTIONS, NETS, before, *track, PAINT)
        return off(begun.result(), whole)

    assert painted() < 0.01 / 255.0
    monkeypatch.setattr(stream.Film, "on", lambda self, corner, sides: None)
    assert painted() > 0.5 / 255.0


def test_a_stroke_with_a_bad_track_or_too_long_is_refused(brush, before):
    begun = stream.Stream(OPTIONS, NETS, before, PAINT)
    track, bounds = pieces(brush, hand("over"))[0]
    with pytest.raises(ValueError, match="not finite"):
        begun.add(track, bounds * np.nan)
    short = stream.Stream(dataclasses.replace(OPTIONS, stamps=(16,)), NETS, before, PAINT)
    short.add(track, bounds)
    with pytest.raises(ValueError, match="33 stamps: expected at most 16"):
        short.result()


def draw(session, samples):
    for k in range(0, 80, 8):
        session.add(*(v if v is None else v[k : k + 8] for v in samples.values()))


def test_a_session_paints_a_long_stroke_while_it_goes_on(brush, before):
    with Session(OPTIONS, NETS, before) as session:
        session.begin(brush, PAINT)
        draw(session, hand("over"))
        found, deadline = [], time.monotonic() + 60.0
        while not found and time.monotonic() < deadline:
            time.sleep(0.01)
            found = session.poll()
        assert found and not any(p.final or p.error for p in found)
        # It shows, but is none of the canvas, and can be taken back.
        assert np.array_equal(session.canvas.height, before.height)
        assert not np.array_equal(session.shown.height, before.height)
        session.undo()
        assert session.wait(60.0) and session.poll() == []
        assert np.array_equal(session.shown.height, before.height)
        assert np.array_equal(session.shown.color, before.color)
        # Once more, to its end.
        session.begin(brush, PAINT)
        draw(session, hand("over"))
        session.end()
        assert session.wait(60.0)
        (last,) = [p for p in session.poll() if p.final]
        assert last.error is None
        painted = session.canvas
        assert np.array_equal(session.shown.height, painted.height)
        session.undo()
        assert np.array_equal(session.shown.height, before.height)
    begun = stream.Stream(OPTIONS, NETS, before, PAINT)
    for piece in pieces(brush, hand("over")):
        begun.add(*piece)
    late = painter.paint_track(OPTIONS, NETS, before, begun.track(), begun.bounds, PAINT)
    assert off(painted, late) < 1.0 / 255.0


def test_an_error_while_a_stroke_goes_on_keeps_its_preview(brush, before, monkeypatch):
    def fail(*_):
        raise FloatingPointError("networks out of order")

    with Session(OPTIONS, NETS, before) as session:
        with monkeypatch.context() as patch:
            patch.setattr(stream.Stream, "paint", fail)
            session.begin(brush, PAINT)
            draw(session, hand("over"))
            session.end()
            assert session.wait(60.0)
        (bad,) = session.poll()
        assert isinstance(bad.error, FloatingPointError) and bad.final
        assert not np.array_equal(session.canvas.height, before.height)
        session.begin(brush, PAINT)
        draw(session, hand("back"))
        session.end()
        assert session.wait(60.0) and [p.error for p in session.poll() if p.final] == [None]
