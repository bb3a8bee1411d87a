"""Session files round-trip exactly, and damaged ones say where and why."""

import dataclasses
import gzip
import json
import math
from pathlib import Path

import numpy as np
import pytest

from jaxbrush import recordings
from jaxbrush.recordings import BrushEvent, ColorEvent, RecordingError, Session, StrokeEvent

DATA = Path(__file__).parents[2] / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the recorded data is not here")

SESSION = Session(
    canvas=(200.0, 0.1 + 0.2),
    scale=1 / 3,
    events=(
        BrushEvent({"shape": "flat", "count": 64, "ferrule": {"width": 1e-300, "list": [1, 2.5]}}),
        ColorEvent((1.0, 0.1, math.nextafter(0.0, 1.0))),
        StrokeEvent(
            t=(1.7e9, 1.7e9 + 1 / 128, 1.7e9 + 1 / 128),
            x=(-5.0, math.pi, 1e10),
            y=(-0.0, 2.0, 3.0),
            pressure=(0.0, 1.0, 1 / 7),
            altitude=(0.0, 1.0, math.pi / 2),
            azimuth=(-7.0, 0.0, 7.0),
            twist=(0.1, 0.2, 0.3),
        ),
        StrokeEvent(t=(3.0,), x=(1.0,), y=(2.0,), pressure=(0.5,)),
    ),
)


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "session.jsonl"
    recordings.write(path, SESSION)
    return path


def test_a_session_comes_back_bit_by_bit(file, tmp_path):
    again = recordings.read(file)
    assert again == SESSION
    assert math.copysign(1, again.events[2].y[0]) == -1
    recordings.write(tmp_path / "again.jsonl", again)
    assert (tmp_path / "again.jsonl").read_bytes() == file.read_bytes()


def test_random_floats_come_back(tmp_path):
    rng = np.random.default_rng(0)
    bits = rng.integers(0, 2**64, 3000, dtype=np.uint64).view(np.float64)
    bits = bits[np.isfinite(bits)].tolist()
    count = len(bits)
    pressure = tuple(rng.random(count).tolist())
    stroke = StrokeEvent((0.0,) * count, tuple(bits), tuple(bits[::-1]), pressure)
    recordings.write(tmp_path / "s", Session((1.0, 1.0), 1.0, (stroke,)))
    assert recordings.read(tmp_path / "s").events[0] == stroke


def test_an_empty_session_is_a_session(tmp_path):
    session = Session((10.0, 20.0), 0.1, ())
    recordings.write(tmp_path / "s", session)
    assert recordings.read(tmp_path / "s") == session


def test_the_file_is_as_documented(file):
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    assert lines[0] == {
        "format": "jaxbrush-session",
        "version": 1,
        "canvas": [200.0, 0.1 + 0.2],
        "scale": 1 / 3,
        "events": 4,
    }
    assert [line["event"] for line in lines[1:]] == ["brush", "color", "stroke", "stroke"]
    assert set(lines[4]) == {"event", "t", "x", "y", "pressure"}


@pytest.mark.parametrize(
    ("field", "session"),
    [
        ("scale", dataclasses.replace(SESSION, scale=0.0)),
        ("canvas", dataclasses.replace(SESSION, canvas=(1.0, math.nan))),
        (
            "x",
            dataclasses.replace(
                SESSION, events=(StrokeEvent((0.0,), (math.inf,), (0.0,), (0.0,)),)
            ),
        ),
        ("params.0", dataclasses.replace(SESSION, events=(BrushEvent({"0": math.nan}),))),
        ("change", dataclasses.replace(SESSION, events=(BrushEvent({"size": (1, 2)}),))),
        ("change", dataclasses.replace(SESSION, events=[])),
        ("events", dataclasses.replace(SESSION, events=("stroke",))),
    ],
)
def test_a_session_that_cannot_come_back_is_not_written(file, field, session):
    before = file.read_bytes()
    with pytest.raises(RecordingError, match=field):
        recordings.write(file, session)
    assert file.read_bytes() == before
    assert list(file.parent.iterdir()) == [file]


def test_a_failed_write_leaves_the_old_file(file, monkeypatch):
    def full(*_):
        raise OSError("disk full")

    before = file.read_bytes()
    monkeypatch.setattr(recordings.os, "replace", full)
    with pytest.raises(OSError, match="disk full"):
        recordings.write(file, dataclasses.replace(SESSION, events=()))
    assert file.read_bytes() == before
    assert list(file.parent.iterdir()) == [file]


def damage(file, line, changes):
    """Changes fields of one line (1-based); a change to None removes the field."""
    lines = file.read_text().splitlines()
    record = json.loads(lines[line - 1]) | changes
    lines[line - 1] = json.dumps({k: v for k, v in record.items() if v is not None})
    file.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(
    ("line", "changes", "field", "expected"),
    [
        (1, {"format": "other"}, "format", "'jaxbrush-session'"),
        (1, {"format": None}, "format", "'jaxbrush-session'"),
        (1, {"version": 2}, "version", "1"),
        (1, {"version": True}, "version", "1"),
        (1, {"canvas": [1.0]}, "canvas", "2"),
        (1, {"canvas": [1.0, -1.0]}, "canvas", "above 0"),
        (1, {"scale": None}, "scale", "a number"),
        (1, {"scale": 0}, "scale", "above 0"),
        (1, {"author": "me"}, "author", "canvas"),
        (2, {"event": "erase"}, "event", "'brush', 'color' or 'stroke'"),
        (2, {"params": [1]}, "params", "an object"),
        (2, {"params": {"a": [{"b": math.inf}]}}, "params.a.0.b", "a finite number"),
        (2, {"size": 3}, "size", "params"),
        (3, {"rgb": [0.1, 0.2]}, "rgb", "3"),
        (3, {"rgb": [0.1, 0.2, 1.5]}, "rgb[2]", "within [0, 1]"),
        (3, {"rgb": "red"}, "rgb", "a list of numbers"),
        (4, {"t": [1.0, 2.0, 1.5]}, "t[2]", "no step back"),
        (4, {"t": None}, "t", "a list of numbers"),
        (4, {"t": []}, "t", "some"),
        (4, {"x": [1.0, 2.0]}, "x", "3"),
        (4, {"y": [1.0, math.nan, 2.0]}, "y[1]", "a finite number"),
        (4, {"x": [1.0, 2.0, 10**400]}, "x[2]", "a finite number"),
        (4, {"y": [1.0, "2", 2.0]}, "y[1]", "a number"),
        (4, {"y": [1.0, True, 2.0]}, "y[1]", "a number"),
        (4, {"pressure": [0.0, 1.0, 1.0000001]}, "pressure[2]", "within [0, 1]"),
        (4, {"pressure": [0.0, -0.1, 1.0]}, "pressure[1]", "within [0, 1]"),
        (4, {"altitude": [0.0, 1.0, 1.6]}, "altitude[2]", "within [0, 1.5708]"),
        (4, {"azimuth": [0.0]}, "azimuth", "3"),
        (4, {"tilt": [0.0]}, "tilt", "altitude"),
        (5, {"pressure": []}, "pressure", "1"),
    ],
)
def test_damage_is_reported_with_file_line_and_field(file, line, changes, field, expected):
    damage(file, line, changes)
    with pytest.raises(RecordingError) as error:
        recordings.read(file)
    message = str(error.value)
    assert message.startswith(f"{file}:{line}: {field}: ")
    assert expected in message.split("expected ", 1)[1]


@pytest.mark.parametrize(
    ("text", "line", "field"),
    [
        (b"", 1, "line"),
        (b"\n", 1, "line"),
        (b"[]\n", 1, "line"),
        (b"{}\n", 1, "format"),
        (b"\xff\xfe\n", 1, "line"),
        (b"not json\n", 1, "line"),
        (b"[" * 100_000 + b"\n", 1, "line"),
    ],
)
def test_a_file_of_something_else_is_refused(tmp_path, text, line, field):
    (tmp_path / "s").write_bytes(text)
    with pytest.raises(RecordingError, match=f"s:{line}: {field}: .*expected"):
        recordings.read(tmp_path / "s")


def test_every_truncation_is_noticed(file):
    data = file.read_bytes()
    for size in range(len(data)):
        file.write_bytes(data[:size])
        line = max(data[:size].count(b"\n") + (data[:size][-1:] != b"\n"), 1)
        with pytest.raises(
            RecordingError, match=f"session.jsonl:{line}: (line|events): .*expected"
        ):
            recordings.read(file)


def test_added_and_broken_lines_are_noticed(file):
    lines = file.read_text().splitlines(keepends=True)
    for text, line, field in (
        ("".join(lines + lines[-1:]), 6, "events"),
        ("".join(lines[:2] + ["\n"] + lines[2:]), 3, "line"),
        ("".join(lines[:2] + [lines[2][:-3] + "\n"] + lines[3:]), 3, "line"),
    ):
        file.write_text(text)
        with pytest.raises(RecordingError, match=f"session.jsonl:{line}: {field}: .*expected"):
            recordings.read(file)


def test_strokes_are_in_millimetres_and_start_at_zero():
    stroke = recordings.to_stroke(SESSION, SESSION.events[2])
    np.testing.assert_array_equal(stroke.time, [0, 1 / 128, 1 / 128])
    np.testing.assert_allclose(stroke.position[1], [math.pi / 3, 2 / 3], rtol=1e-6)
    np.testing.assert_allclose(stroke.pressure, [0, 1, 1 / 7], rtol=1e-6)
    # The session keeps what the pen reported; the brush is not laid flatter than it can be.
    assert SESSION.events[2].altitude[0] == 0.0
    np.testing.assert_allclose(stroke.altitude, [0.35, 1, math.pi / 2], rtol=1e-6)
    np.testing.assert_allclose(stroke.azimuth, [-7, 0, 7])
    np.testing.assert_allclose(stroke.twist, [0.1, 0.2, 0.3], rtol=1e-6)


def test_a_dab_without_tilt_is_upright():
    stroke = recordings.to_stroke(SESSION, SESSION.events[3])
    assert stroke.position.shape == (1, 2) and bool(stroke.valid[0])
    np.testing.assert_allclose(stroke.altitude, [math.pi / 2], rtol=1e-6)
    np.testing.assert_array_equal([*stroke.azimuth, *stroke.twist], [0, 0])


# Importers


def test_mypaint_rows_part_at_pressure_zero(tmp_path):
    path = tmp_path / "pen.dat"
    path.write_text("0 1 2 0\n.1 3 4 .5\n.2 5 6 .6\n.3 7 8 0\n.4 7 8 0\n.5 9 1 .7\n")
    session = recordings.read_mypaint(path, scale=0.5)
    assert session.events == (
        StrokeEvent((0.1, 0.2), (3.0, 5.0), (4.0, 6.0), (0.5, 0.6)),
        StrokeEvent((0.5,), (9.0,), (1.0,), (0.7,)),
    )
    assert session.canvas == (4.5, 3.0) and session.scale == 0.5


@pytest.mark.parametrize(
    ("text", "line", "field"),
    [
        ("0 1 2 .5\n0 1 2\n", 2, "row"),
        ("0 1 2 .5\n0 1 x .5\n", 2, "y"),
        ("0 nan 2 .5\n", 1, "x"),
        ("0 1 2 1.5\n", 1, "pressure"),
        ("1 1 2 .5\n.5 1 2 .5\n", 2, "t"),
        ("0 1 2 .5\n0 1 2 .", 2, "line"),
        ("0 1 2 0\n", 1, "stroke"),
        ("0 -1 2 1\n", 1, "canvas"),
        ("", 1, "line"),
    ],
)
def test_damaged_mypaint_rows_are_reported(tmp_path, text, line, field):
    path = tmp_path / "pen.dat"
    path.write_text(text)
    with pytest.raises(RecordingError, match=f"pen.dat:{line}: {field}: .*expected"):
        recordings.read_mypaint(path)


INK = {"X": [1, 2], "Y": [3, 4], "Timestamp": [0, 8], "Pressure": [0.1, 0.2], "Azimuth": [-1, 1]}


@pytest.mark.parametrize("pack", [bytes, gzip.compress])
def test_wacom_strokes_plain_and_packed(tmp_path, pack):
    path = tmp_path / "ink"
    path.write_bytes(pack((json.dumps(INK | {"file": "a"}) + "\n").encode()))
    session = recordings.read_wacom(path)
    expected = StrokeEvent((0.0, 0.008), (1.0, 2.0), (3.0, 4.0), (0.1, 0.2), azimuth=(-1.0, 1.0))
    assert session.events == (expected,)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"Pressure": [0.1, 2]}, r"Pressure\[1\]"),
        ({"Timestamp": [1, 0]}, r"Timestamp\[1\]"),
        ({"X": [1]}, "X"),
        ({"Altitude": [1, -1]}, r"Altitude\[1\]"),
    ],
)
def test_damaged_wacom_strokes_are_reported(tmp_path, changes, field):
    path = tmp_path / "ink"
    path.write_text(json.dumps(INK) + "\n" + json.dumps(INK | changes) + "\n")
    with pytest.raises(RecordingError, match=f"ink:2: {field}: .*expected"):
        recordings.read_wacom(path)


def test_damaged_gzip_is_reported(tmp_path):
    packed = gzip.compress(json.dumps(INK).encode())
    for data in (packed[:-12], packed[:15] + b"\0\0\0\0" + packed[19:], packed[:3]):
        (tmp_path / "ink").write_bytes(data)
        with pytest.raises(RecordingError, match="ink:1: gzip: .*expected whole gzip data"):
            recordings.read_wacom(tmp_path / "ink")


@needs_data
def test_the_painting_recording(tmp_path):
    session = recordings.read_mypaint(DATA / "painting_recording.dat")
    strokes = [np.array([e.t, e.x, e.y, e.pressure]) for e in session.events]
    # The first half of a session of 30 pen-down runs and 2,253 rows in contact.
    assert len(strokes) == 6 and sum(s.shape[1] for s in strokes) == 1314
    speed = np.concatenate([np.hypot(*np.diff(s[1:3], axis=1)) / np.diff(s[0]) for s in strokes])
    assert 835 < np.median(speed) < 840 and 4767 < speed.max() < 4769
    assert 0.54 < max(s[3].max() for s in strokes) < 0.55
    recordings.write(tmp_path / "s", session)
    assert recordings.read(tmp_path / "s") == session


@needs_data
def test_the_pen_recording(tmp_path):
    session = recordings.read_wacom(DATA / "pen_strokes_tilt.jsonl.gz")
    assert len(session.events) == 1094 and sum(len(e.t) for e in session.events) == 23400
    altitude = np.concatenate([e.altitude for e in session.events])
    assert altitude.min() == 0.02 and altitude.max() == 1.48
    interval = np.concatenate([np.diff(e.t) for e in session.events])
    assert 0.015 < np.median(interval) < 0.017
    recordings.write(tmp_path / "s", session)
    assert recordings.read(tmp_path / "s") == session
