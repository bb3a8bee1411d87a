"""Recorded painting sessions: one exact file format, and importers for pen formats.

A session file is JSON Lines in UTF-8; every line, the last too, ends with a newline.

Line 1 is the header:

    {"format": "jaxbrush-session", "version": 1, "canvas": [width, height], "scale": s, "events": n}

with the canvas in mm, `scale` in mm per device unit, and the number of event lines that follow,
which shows when a file was cut off. The origin of device units is the canvas' top-left corner, x
right, y down. Each further line is one event, in the order in which the painter made them:

    {"event": "brush", "params": {...}}         the brush taken up: names and finite numbers
    {"event": "color", "rgb": [r, g, b]}        paint taken up, linear RGB in [0, 1]
    {"event": "stroke", "t": [...], "x": [...], "y": [...], "pressure": [...],
     "altitude": [...], "azimuth": [...], "twist": [...]}

A stroke holds the samples of the device as they came, with one or more entries an array: `t` in
s, not decreasing, from any origin; `x`, `y` in device units, possibly outside the canvas;
`pressure` in [0, 1]; and, where the device has them, `altitude` in [0, pi/2], `azimuth` and
`twist`, any angle, in rad. Numbers are written by their shortest exact form, so a session that is
written and read is equal to the first, bit by bit. Unknown fields are errors: nothing is dropped.
"""

import dataclasses
import gzip
import json
import math
import os
import zlib
from pathlib import Path

from jaxbrush.stylus import Stroke, make_stroke

FORMAT = "jaxbrush-session"
VERSION = 1

_REQUIRED = ("t", "x", "y", "pressure")
LOWEST_ALTITUDE = 0.35
"""Pens are read as held no flatter than 20 degrees [rad]: some report 1, where a brush would lie on
the canvas with its belly, which the nodes near the tip cannot show."""
_OPTIONAL = ("altitude", "azimuth", "twist")
_RANGES = {"pressure": (0.0, 1.0), "altitude": (0.0, math.pi / 2)}


class RecordingError(ValueError):
    """A file that is not what it should be: the message says where, and what was expected."""


@dataclasses.dataclass(frozen=True)
class BrushEvent:
    """The painter takes a brush; `params` maps names to JSON values (finite numbers)."""

    params: dict


@dataclasses.dataclass(frozen=True)
class ColorEvent:
    """The painter takes paint; `rgb` is linear, each in [0, 1]."""

    rgb: tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class StrokeEvent:
    """Raw samples of one pen contact; the module's text gives units and ranges."""

    t: tuple[float, ...]
    x: tuple[float, ...]
    y: tuple[float, ...]
    pressure: tuple[float, ...]
    altitude: tuple[float, ...] | None = None
    azimuth: tuple[float, ...] | None = None
    twist: tuple[float, ...] | None = None


Event = BrushEvent | ColorEvent | StrokeEvent


@dataclasses.dataclass(frozen=True)
class Session:
    """What a painter did, in order.

    Attributes:
      canvas: width, height [mm].
      scale: mm per device unit.
      events: brushes, colors and strokes.
    """

    canvas: tuple[float, float]
    scale: float
    events: tuple[Event, ...]


def read(path) -> Session:
    """Reads a session file.

    Args:
      path: the file.
    Returns:
      The whole session; the file is checked to its end first.
    Raises:
      RecordingError: naming file, line and field, and what was expected there.
    """
    return _parse(path, Path(path).read_bytes())


def write(path, session: Session) -> None:
    """Writes a session file; a reader sees the old file or the whole new one.

    Args:
      path: the file.
      session: the session.
    Raises:
      RecordingError: when the session would not be read back as it is; nothing is written then.
    """
    path = Path(path)
    header = {
        "format": FORMAT,
        "version": VERSION,
        "canvas": session.canvas,
        "scale": session.scale,
        "events": len(session.events),
    }
    lines = [header, *map(_as_dict, session.events)]
    data = "".join(json.dumps(line) + "\n" for line in lines).encode()
    if _parse(path, data) != session:
        raise RecordingError(
            f"{path}: the session would change in writing, expected tuples of float, and JSON "
            "values in brush params"
        )
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(data)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def to_stroke(session: Session, event: StrokeEvent) -> Stroke:
    """Converts raw samples to a stroke in mm, with time from its first sample.

    Args:
      session: gives the scale.
      event: the samples; a pen without tilt is held perpendicular, one held flatter than
        `LOWEST_ALTITUDE` at that.
    Returns:
      The stroke, every sample valid.
    """
    scale, start = session.scale, event.t[0]
    # In double precision: seconds since 1970 do not fit float32.
    return make_stroke(
        position=[(x * scale, y * scale) for x, y in zip(event.x, event.y, strict=True)],
        time=[t - start for t in event.t],
        pressure=event.pressure,
        altitude=math.pi / 2
        if event.altitude is None
        else [max(a, LOWEST_ALTITUDE) for a in event.altitude],
        azimuth=0.0 if event.azimuth is None else event.azimuth,
        twist=0.0 if event.twist is None else event.twist,
    )


def read_mypaint(path, scale: float = 0.1) -> Session:
    """Imports a libmypaint event file: rows of t [s], x, y [px] and pressure.

    Rows of pressure 0 hover and part the strokes. The canvas reaches from the origin to the
    farthest sample.

    Args:
      path: the file.
      scale: mm per pixel.
    Returns:
      A session of strokes.
    Raises:
      RecordingError: naming file, line and field.
    """
    strokes, rows, before = [], [], -math.inf

    def lift():
        if rows:
            strokes.append(StrokeEvent(*zip(*rows, strict=True)))
            rows.clear()

    for number, text in enumerate(_lines(path, Path(path).read_bytes()), 1):
        where = f"{path}:{number}"
        words = text.split()
        if len(words) != len(_REQUIRED):
            raise RecordingError(f"{where}: row: {len(words)} columns, expected t x y pressure")
        row = [_word(where, *pair) for pair in zip(_REQUIRED, words, strict=True)]
        if row[0] < before:
            raise RecordingError(f"{where}: t: {row[0]} after {before}, expected no step back")
        before = row[0]
        if row[3] > 0:
            rows.append(row)
        else:
            lift()
    lift()
    return _imported(path, scale, strokes)


def read_wacom(path, scale: float = 0.1) -> Session:
    """Imports Universal Ink strokes, one JSON object a line, plain or gzip.

    Used fields: `X`, `Y` [device units], `Timestamp` [ms], `Pressure`, and where present
    `Altitude`, `Azimuth` [rad]. The canvas reaches from the origin to the farthest sample.

    Args:
      path: the file.
      scale: mm per device unit.
    Returns:
      A session of strokes; t is in s from the origin that the file has.
    Raises:
      RecordingError: naming file, line and field.
    """
    data = Path(path).read_bytes()
    if data[:2] == b"\x1f\x8b":
        try:
            data = gzip.decompress(data)
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            raise RecordingError(f"{path}:1: gzip: {error}, expected whole gzip data") from error
    names = {"t": "Timestamp", "x": "X", "y": "Y", "pressure": "Pressure"}
    names |= {"altitude": "Altitude", "azimuth": "Azimuth"}
    strokes = []
    for number, text in enumerate(_lines(path, data), 1):
        where = f"{path}:{number}"
        line = _object(where, text)
        event = _stroke(where, line, names)
        strokes.append(dataclasses.replace(event, t=tuple(t / 1000.0 for t in event.t)))
    return _imported(path, scale, strokes)


def _as_dict(event):
    """Gives the JSON object of an event, without the fields that the device lacks."""
    kind = {BrushEvent: "brush", ColorEvent: "color", StrokeEvent: "stroke"}.get(type(event))
    if kind is None:
        raise RecordingError(f"events: {event!r}, expected a brush, color or stroke event")
    return {"event": kind} | {k: v for k, v in vars(event).items() if v is not None}


def _parse(path, data):
    """Reads a session from bytes; `path` is for messages."""
    lines = _lines(path, data)
    where = f"{path}:1"
    header = _object(where, lines[0])
    for name, expected in (("format", FORMAT), ("version", VERSION)):
        if header.get(name) != expected or isinstance(header[name], bool):
            raise RecordingError(f"{where}: {name}: {header.get(name)!r}, expected {expected!r}")
    _only(where, header, {"format", "version", "canvas", "scale", "events"})
    canvas = _numbers(where, "canvas", header.get("canvas"), 2)
    scale = _number(where, "scale", header.get("scale"))
    for name, value in (("canvas", min(canvas)), ("scale", scale)):
        if value <= 0:
            raise RecordingError(f"{where}: {name}: {value}, expected above 0")
    events = tuple(
        _event(f"{path}:{n}", _object(f"{path}:{n}", x)) for n, x in enumerate(lines[1:], 2)
    )
    if header.get("events") != len(events) or isinstance(header["events"], bool):
        raise RecordingError(
            f"{path}:{len(lines)}: events: the file ends after {len(events)}, expected "
            f"{header.get('events')!r} as line 1 says"
        )
    return Session(canvas, scale, events)


def _event(where, line):
    """Reads one event line."""
    kind = line.get("event")
    if kind == "brush":
        _only(where, line, {"event", "params"})
        if not isinstance(line.get("params"), dict):
            raise RecordingError(f"{where}: params: {line.get('params')!r}, expected an object")
        _finite(where, "params", line["params"])
        return BrushEvent(line["params"])
    if kind == "color":
        _only(where, line, {"event", "rgb"})
        return ColorEvent(_numbers(where, "rgb", line.get("rgb"), 3, (0.0, 1.0)))
    if kind == "stroke":
        _only(where, line, {"event", *_REQUIRED, *_OPTIONAL})
        return _stroke(where, line, {name: name for name in _REQUIRED + _OPTIONAL})
    raise RecordingError(f"{where}: event: {kind!r}, expected 'brush', 'color' or 'stroke'")


def _stroke(where, line, names):
    """Reads a stroke from the fields of a line; `names` maps ours to the file's."""
    fields, count = {}, None
    for ours, name in names.items():
        if ours in _OPTIONAL and name not in line:
            continue
        fields[ours] = _numbers(where, name, line.get(name), count, _RANGES.get(ours))
        count = len(fields[ours])
    for i, (a, b) in enumerate(zip(fields["t"], fields["t"][1:], strict=False), 1):
        if b < a:
            raise RecordingError(
                f"{where}: {names['t']}[{i}]: {b} after {a}, expected no step back"
            )
    return StrokeEvent(**fields)


def _numbers(where, name, value, count=None, bounds=None):
    """Checks a list of finite numbers, and gives it as a tuple of float."""
    if not isinstance(value, list):
        raise RecordingError(f"{where}: {name}: {value!r}, expected a list of numbers")
    if len(value) != count if count else not value:
        raise RecordingError(f"{where}: {name}: {len(value)} numbers, expected {count or 'some'}")
    return tuple(_number(where, f"{name}[{i}]", x, bounds) for i, x in enumerate(value))


def _number(where, name, value, bounds=None):
    """Checks one finite number within bounds, and gives it as float."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise RecordingError(f"{where}: {name}: {value!r}, expected a number")
    try:
        value = float(value)
    except OverflowError:
        value = math.inf  # a whole number too long for a float
    low, high = bounds or (-math.inf, math.inf)
    if not math.isfinite(value):
        raise RecordingError(f"{where}: {name}: {value}, expected a finite number")
    if not low <= value <= high:
        raise RecordingError(f"{where}: {name}: {value}, expected within [{low:.6g}, {high:.6g}]")
    return value


def _finite(where, name, value):
    """Checks the numbers in a JSON value at any depth."""
    if isinstance(value, float):
        _number(where, name, value)
    elif isinstance(value, dict | list):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            _finite(where, f"{name}.{key}", inner)


def _word(where, name, text):
    """Reads one number of a text row."""
    try:
        value = float(text)
    except ValueError as error:
        raise RecordingError(f"{where}: {name}: {text!r}, expected a number") from error
    return _number(where, name, value, _RANGES.get(name))


def _only(where, line, known):
    """Refuses fields that the format does not know."""
    for name in line:
        if name not in known:
            raise RecordingError(f"{where}: {name}: unknown field, expected {sorted(known)}")


def _object(where, text):
    """Reads the JSON object on one line."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"{where}: line: {error}, expected one JSON object") from error
    if not isinstance(value, dict):
        raise RecordingError(f"{where}: line: {text[:40]!r}, expected one JSON object")
    return value


def _lines(path, data):
    """Splits bytes into lines of text, each ended by a newline."""
    lines = data.split(b"\n")
    if lines.pop():
        raise RecordingError(
            f"{path}:{len(lines) + 1}: line: cut off, expected a newline at its end"
        )
    if not lines:
        raise RecordingError(f"{path}:1: line: the file is empty, expected a first line")
    texts = []
    for number, line in enumerate(lines, 1):
        try:
            texts.append(line.decode())
        except UnicodeDecodeError as error:
            raise RecordingError(f"{path}:{number}: line: {error}, expected UTF-8") from error
    return texts


def _imported(path, scale, strokes):
    """Puts imported strokes on a canvas that reaches from the origin to the farthest sample."""
    if not strokes:
        raise RecordingError(f"{path}:1: stroke: none in the file, expected pen contact")
    width, height = (max(max(getattr(s, k)) for s in strokes) * scale for k in "xy")
    if not min(width, height) > 0:
        raise RecordingError(f"{path}:1: canvas: {width} x {height} mm, expected above 0")
    return Session((width, height), scale, tuple(strokes))
