"""The session: previews at once, networks on a thread, undo, errors, recording; nothing is lost."""

import threading
import time
import types

import jax
import numpy as np
import pytest

from jaxbrush import painter, recordings
from jaxbrush.batches import PREVIEW_FILM
from jaxbrush.brush import make_brush
from jaxbrush.canvas import Canvas, blank
from jaxbrush.session import Session
from jaxbrush.stylus import make_stroke

OPTIONS = painter.PainterConfig()
SHAPE = (96, 128)
RED, BLUE = (0.8, 0.1, 0.05), (0.05, 0.1, 0.6)
PATH = np.linspace([3.0, 4.0], [9.0, 6.0], 30)


@pytest.fixture(scope="module")
def brush():
    return make_brush(
        jax.random.key(0), OPTIONS.brush, "flat", 12, width=2.0, thickness=0.7, length=12.0,
        press_depth=3.0,
    )  # fmt: skip


class Painter:
    """In place of the networks: fills the box of the stroke, when it is let."""

    def __init__(self):
        self.go = threading.Event()
        self.go.set()
        self.begun, self.fail = threading.Event(), set()
        self.count, self.loads = 0, []

    def __call__(self, options, nets, canvas, brush, color, stroke, watch, load=painter.LOAD):
        self.begun.set()
        assert self.go.wait(60.0)
        self.count += 1
        self.loads.append(load)
        if self.count in self.fail:
            raise FloatingPointError("networks out of order")
        place = np.asarray(stroke.position) / options.pixel
        low, high = place.min(0) - 3.0, place.max(0) + 3.0
        bounds = np.asarray([[low[1], low[0], high[1], high[0]]], np.float32)
        watch("brush", (None, bounds))
        rows, columns = painter.reached(canvas.height.shape, bounds)
        height = np.array(canvas.height)
        paint = np.array(canvas.color)
        height[rows, columns] += 0.1
        paint[rows, columns] = 0.5 * paint[rows, columns] + 0.5 * np.asarray(color)
        return Canvas(jax.numpy.asarray(height), jax.numpy.asarray(paint))


@pytest.fixture
def fake():
    return Painter()


@pytest.fixture
def session(fake):
    with Session(OPTIONS, None, blank(SHAPE), undo=3, paint=fake) as made:
        yield made
        fake.go.set()


def pen(path=PATH):
    count = len(path)
    press = 0.5 * np.clip(np.minimum(np.arange(count), np.arange(count)[::-1]) / 4.0, 0.0, 1.0)
    return 0.01 * np.arange(count), path[:, 0], path[:, 1], press


def draw(session, brush, color=RED, path=PATH, event=None):
    session.begin(brush, color, event)
    t, x, y, p = pen(path)
    found = []
    for k in range(0, len(t), 7):
        found += session.add(*(v[k : k + 7] for v in (t, x, y, p)))
    return session.end(), found


def same(a: Canvas, b: Canvas) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(*map(jax.tree.leaves, (a, b)), strict=True))


def test_a_preview_comes_at_once_and_the_finished_stroke_replaces_it(session, fake, brush):
    fake.go.clear()
    number, previews = draw(session, brush)
    assert previews and not any(p.final for p in previews)
    shown = session.shown
    assert shown.height.max() == np.float32(PREVIEW_FILM)
    for p in previews:
        assert p.canvas.height.shape == p.canvas.color.shape[:2]
    assert session.poll() == [] and not session.wait(0.0)
    assert np.asarray(session.canvas.height).max() == 0.0
    fake.go.set()
    assert session.wait(60.0)
    (patch,) = session.poll()
    assert patch.final and patch.stroke == number and patch.error is None
    assert same(session.shown, session.canvas)
    h, w = patch.canvas.height.shape
    y, x = patch.corner
    part = jax.tree.map(lambda v: v[y : y + h, x : x + w], session.canvas)
    assert same(part, patch.canvas)


def test_preview_piece_by_piece_covers_what_the_whole_stroke_does(session, brush):
    _, previews = draw(session, brush)
    track, bounds = painter._begin(OPTIONS, brush, make_stroke(PATH, *pen()[::3]))
    box = painter.place(OPTIONS, SHAPE, bounds)
    cover, corner = painter.covered(OPTIONS, box, track)
    whole = np.zeros(SHAPE, bool)
    rows, columns = np.nonzero(np.asarray(cover))
    rows, columns = rows + int(corner[0]), columns + int(corner[1])
    there = (rows >= 0) & (rows < SHAPE[0]) & (columns >= 0) & (columns < SHAPE[1])
    whole[rows[there], columns[there]] = True
    pieces = np.zeros(SHAPE, bool)
    for p in previews:
        y, x = p.corner
        h, w = p.canvas.height.shape
        pieces[y : y + h, x : x + w] |= p.canvas.height > 0.0
    assert (whole & pieces).sum() > 0.95 * (whole | pieces).sum()


def test_a_stroke_over_an_unfinished_one(session, fake, brush):
    fake.go.clear()
    first, _ = draw(session, brush)
    fake.begun.wait(60.0)
    second, _ = draw(session, brush, BLUE, PATH[::-1] + [0.5, 1.0])
    over = np.all(session.shown.color == np.asarray(BLUE, np.float32), axis=-1)
    fake.go.set()
    assert session.wait(60.0)
    news = session.poll()
    assert [p.stroke for p in news] == [first, second]
    # What lies under the later preview did not flash through.
    assert over.any() and same(session.shown, session.canvas)
    alone = blank(SHAPE)
    nobody = types.SimpleNamespace(press_depth=0)
    for color, path in ((RED, PATH), (BLUE, PATH[::-1] + [0.5, 1.0])):
        stroke = make_stroke(path, *pen(path)[::3])
        alone = fake(OPTIONS, None, alone, nobody, np.asarray(color), stroke, lambda *_: None)
    assert np.abs(np.asarray(alone.color) - np.asarray(session.canvas.color)).max() < 1e-6


def test_the_networks_rest_while_the_pen_is_down(session, fake, brush):
    fake.go.clear()
    draw(session, brush)
    assert fake.begun.wait(60.0)
    # The pen comes down while they are at it: they stop after the stage they are in.
    session.begin(brush, BLUE)
    t, x, y, press = pen(PATH + [0.0, 3.0])
    session.add(t[:20], x[:20], y[:20], press[:20])
    fake.go.set()
    time.sleep(0.2)
    assert session.poll() == []
    session.add(t[20:], x[20:], y[20:], press[20:])
    session.end()
    assert session.wait(60.0) and len(session.poll()) == 2
    # Waiting with the pen down does not wait for the pen; taking the open stroke back lifts it.
    draw(session, brush)
    session.begin(brush, BLUE)
    assert session.wait(60.0) and len(session.poll()) == 1
    fake.go.clear()
    session.undo()
    draw(session, brush)
    fake.go.set()
    assert session.wait(60.0)


def test_undo_takes_back_open_waiting_and_finished_strokes(session, fake, brush):
    before = session.canvas
    draw(session, brush)
    session.wait(60.0)
    one = session.canvas
    fake.go.clear()
    fake.begun.clear()
    draw(session, brush, BLUE)
    fake.begun.wait(60.0)  # the networks are at it
    draw(session, brush, BLUE, PATH + [0.0, 2.0])
    session.begin(brush, BLUE)
    session.add(0.0, 5.0, 5.0, 0.5)
    for _ in range(3):
        session.undo()
    fake.go.set()
    assert session.wait(60.0)
    session.poll()
    assert same(session.canvas, one) and same(session.shown, one)
    assert len([e for e in session.record().events if isinstance(e, recordings.StrokeEvent)]) == 1
    patch = session.undo()
    assert patch.final and same(session.canvas, before) and same(session.shown, before)
    assert session.undo() is None
    # It goes on as if nothing had been.
    draw(session, brush)
    assert session.wait(60.0) and same(session.canvas, one)


def test_undo_reaches_as_far_as_its_history(session, brush):
    for k in range(5):
        draw(session, brush, path=PATH + [0.0, 0.3 * k])
    assert session.wait(60.0)
    session.poll()
    assert [session.undo() is not None for _ in range(5)] == [True] * 3 + [False] * 2


def test_an_error_in_the_networks_keeps_the_preview_and_the_next_stroke(session, fake, brush):
    fake.fail = {1}
    first, _ = draw(session, brush)
    second, _ = draw(session, brush, BLUE, PATH + [0.0, 3.0])
    assert session.wait(60.0)
    bad, good = session.poll()
    assert bad.stroke == first and isinstance(bad.error, FloatingPointError)
    assert good.stroke == second and good.error is None
    assert (np.asarray(session.canvas.height) == np.float32(PREVIEW_FILM)).sum() > 50
    assert same(session.shown, session.canvas)


def test_closing_in_the_middle_loses_nothing(fake, brush):
    session = Session(OPTIONS, None, blank(SHAPE), paint=fake)
    fake.go.clear()
    draw(session, brush)
    session.begin(brush, BLUE)
    session.add(*pen(PATH + [0.0, 3.0]))
    threading.Timer(0.2, fake.go.set).start()
    session.close()
    session.close()
    assert fake.count == 2 and len(session.poll()) == 2
    assert not session._worker.is_alive()
    with pytest.raises(RuntimeError, match="closed"):
        session.begin(brush, RED)


def test_the_load_of_the_brush_goes_to_the_painter(session, fake, brush):
    draw(session, brush)
    with pytest.raises(ValueError, match="load = 1.2"):
        session.begin(brush, RED, load=1.2)
    session.begin(brush, RED, load=0.3)
    session.add(*pen())
    session.end()
    assert session.wait(60.0)
    assert fake.loads == [painter.LOAD, 0.3]


def test_bad_samples_are_refused_whole(session, brush):
    with pytest.raises(RuntimeError, match="no stroke is open"):
        session.add(0.0, 1.0, 1.0, 0.5)
    session.begin(brush, RED)
    session.add(0.0, 4.0, 4.0, 0.5)
    before = session.shown
    for bad, match in (
        (dict(time=-1.0, x=1.0, y=1.0, pressure=0.5), "time"),
        (dict(time=1.0, x=np.nan, y=1.0, pressure=0.5), "x = nan"),
        (dict(time=[1.0, 2.0], x=[1.0, 2.0], y=[1.0, 2.0], pressure=[0.5, 1.5]), "pressure"),
        (dict(time=[1.0, 2.0, 3.0], x=[1.0, 2.0], y=[1.0, 2.0], pressure=0.5), "time"),
    ):
        with pytest.raises(ValueError, match=match):
            session.add(**bad)
    assert same(session.shown, before)
    with pytest.raises(RuntimeError, match="a stroke is open"):
        session.begin(brush, RED)
    # Off the canvas, at rest, nothing at all: a stroke all the same.
    assert session.add([], [], [], []) == []
    session.add([1.0, 1.0], [-500.0, -500.0], [4.0, 4.0], 0.5)
    session.end()
    assert session.wait(60.0)


def test_a_recorded_session_comes_back_as_it_was(session, brush, tmp_path):
    draw(session, brush, event={"shape": "flat", "width": 2.0})
    draw(session, brush, BLUE, PATH + [0.0, 2.0], {"shape": "flat", "width": 2.0})
    recordings.write(tmp_path / "a.jsonl", session.record())
    back = recordings.read(tmp_path / "a.jsonl")
    kinds = [type(e).__name__ for e in back.events]
    assert kinds == ["BrushEvent", "ColorEvent", "StrokeEvent", "ColorEvent", "StrokeEvent"]
    assert back.events[0].params == {"shape": "flat", "width": 2.0, "load": painter.LOAD}
    stroke = recordings.to_stroke(back, back.events[2])
    np.testing.assert_allclose(stroke.position, PATH, atol=1e-6)
    assert back.canvas == (SHAPE[1] * 0.125, SHAPE[0] * 0.125)
