"""A painting in progress: pen samples in, a preview at once, the networks' paint when it is done.

The only object with a life of its own in this package: it holds a canvas, a thread that runs the
networks stroke by stroke, and what undo needs. All that computes is in `painter` and `stream`.
"""

import collections
import dataclasses
import queue
import threading

import jax
import numpy as np

from jaxbrush import painter
from jaxbrush.batches import PREVIEW_FILM
from jaxbrush.brush import BrushParams
from jaxbrush.canvas import Canvas
from jaxbrush.loaded import LOAD
from jaxbrush.painter import Nets, PainterConfig
from jaxbrush.patches import Box
from jaxbrush.pen import FIELDS, Pen, checked
from jaxbrush.recordings import BrushEvent, ColorEvent, StrokeEvent
from jaxbrush.recordings import Session as Recording
from jaxbrush.screen import Screen, part_of, with_part
from jaxbrush.stream import Stream, local
from jaxbrush.stylus import Stroke


@dataclasses.dataclass(frozen=True)
class Patch:
    """A part of the picture that is new. stroke: number of the stroke, from 1. corner: first pixel
    (y, x). canvas: of numpy arrays. final: False for a preview, and for what the networks have
    painted of a stroke that goes on. error: what stopped the networks; the preview then stays."""

    stroke: int
    corner: tuple[int, int]
    canvas: Canvas
    final: bool
    error: Exception | None = None


@dataclasses.dataclass(eq=False)
class _Job:
    """A stroke on its way. box: (y, x) slices that it may change, once known. bounds: of its final
    pieces. long: whether it is painted while it goes on, by `stream`."""

    number: int
    brush: BrushParams
    color: tuple[float, float, float]
    event: dict
    load: float = LOAD
    stroke: Stroke | None = None
    samples: dict | None = None
    cancelled: bool = False
    box: tuple[slice, slice] | None = None
    before: Canvas | None = None
    error: Exception | None = None
    bounds: list[np.ndarray] = dataclasses.field(default_factory=list)
    long: bool = False
    stream: Stream | None = None


class Session:
    """Paints while the pen moves.

    The pen goes first: while it is down the networks rest, between the stages of a stroke, so that
    previews find the processor free. They go on when it is lifted, or in `wait` and `close`; or
    when the stroke under it has become too long to be painted in one piece. Then networks that see
    only what is near (`stream.local`) paint what the brush has left behind.

    Call from one thread. `begin`, `add`, `end` draw a stroke; each returns in a frame. `poll` gives
    what the networks have finished since. `with Session(...) as session` closes it at the end.

    Args:
      options, nets: of the painter. canvas: what is painted on. undo: strokes that can be taken
        back.
      paint: what paints a stroke, for tests: `painter.paint_stroke`.
    """

    def __init__(
        self, options: PainterConfig, nets: Nets, canvas: Canvas, undo: int = 32,
        paint=painter.paint_stroke,
    ):  # fmt: skip
        self.options, self._nets, self._paint = options, nets, paint
        self._canvas = canvas
        self._shape, self._screen = canvas.height.shape, Screen(canvas)
        self._lock = threading.Lock()
        self._idle = threading.Condition(self._lock)
        self._queue = queue.SimpleQueue()
        self._lifted = threading.Event()
        self._lifted.set()
        self._waiting: list[_Job] = []
        self._history = collections.deque(maxlen=undo)
        self._news: list[Patch] = []
        self._strokes: list[_Job] = []
        self._count, self._open, self._pen, self._closed = 0, None, None, False
        self._streams = nets is not None and local(nets) and paint is painter.paint_stroke
        self._worker = threading.Thread(target=self._work, name="painter", daemon=True)
        self._worker.start()

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()

    @property
    def canvas(self) -> Canvas:
        """The finished picture: strokes that the networks are done with."""
        return self._canvas

    @property
    def shown(self) -> Canvas:
        """The picture with previews of what is not finished; a copy, as numpy arrays."""
        return jax.tree.map(np.copy, self._screen.canvas)

    def begin(
        self, brush: BrushParams, color, event: dict | None = None, load: float = LOAD
    ) -> int:
        """Sets the brush down for a stroke.

        Args:
          brush: of `options.brush`. color: (3,) linear RGB. event: the brush in the recording.
          load: share of what the brush holds that it is loaded with, (0, 1].

        Returns:
          Number of the stroke.

        Raises:
          RuntimeError: a stroke is open, or the session is closed. ValueError: a load out of range.
        """
        painter.check_load(load)
        if self._closed or self._open:
            raise RuntimeError("the session is closed" if self._closed else "a stroke is open")
        self._count += 1
        color = tuple(float(c) for c in color)
        self._open = _Job(self._count, brush, color, event or {}, float(load))
        self._pen = Pen(self.options, brush, load)
        self._lifted.clear()
        return self._count

    def add(self, time, x, y, pressure, altitude=None, azimuth=None, twist=None) -> list[Patch]:
        """Moves the pen along new samples: numbers, or arrays of equal length.

        Args:
          time: [s], not decreasing. x, y: on the canvas [mm]. pressure: [0, 1]. altitude, azimuth,
            twist: [rad]; upright where they are not given.

        Returns:
          The parts of the preview that changed.

        Raises:
          ValueError: bad samples, of which none is taken. RuntimeError: no stroke is open.
        """
        if not self._open:
            raise RuntimeError("no stroke is open: call begin")
        new = checked(self._pen, dict(zip(
            FIELDS, (time, x, y, pressure, altitude, azimuth, twist), strict=True
        )))  # fmt: skip
        if not new["x"].size:
            return []
        self._pen.add(new)
        found = []
        for track, bounds, final in self._pen.advance():
            found.append(self._preview(track, bounds))
            if final and self._streams:
                self._flow(track, bounds)
        return [patch for patch in found if patch]

    def _flow(self, track, bounds):
        """Hands a piece to the networks' thread, and wakes it where the stroke is long."""
        job = self._open
        self._queue.put((job, (track, bounds)))
        job.bounds.append(np.asarray(bounds))
        if not job.long:
            box = painter.place(self.options, self._shape, np.concatenate(job.bounds))
            job.long = isinstance(box, Box)
        if job.long:
            self._lifted.set()

    def end(self) -> int:
        """Lifts the brush; the networks take over. Returns the number of the stroke.

        Raises:
          RuntimeError: no stroke is open.
        """
        if not self._open:
            raise RuntimeError("no stroke is open: call begin")
        job, pen = self._open, self._pen
        self._lift()
        if pen.samples["x"].size:
            if self._streams:
                self._queue.put((job, pen.tip))
            job.stroke, job.samples = pen.stroke(), pen.samples
            with self._lock:
                self._strokes.append(job)
                self._waiting.append(job)
            self._queue.put((job, None))
        return job.number

    def poll(self) -> list[Patch]:
        """Parts of the picture that the networks have finished since the last call."""
        with self._lock:
            news, self._news = self._news, []
        for patch in news:
            self._screen.show(patch.corner, patch.canvas, patch.stroke, patch.final)
        return news

    def wait(self, timeout: float | None = None) -> bool:
        """Waits until every stroke that was ended is finished; False after `timeout` seconds."""
        self._lifted.set()
        with self._idle:
            done = self._idle.wait_for(lambda: not self._waiting, timeout)
        if self._open and not self._open.long:
            self._lifted.clear()
        return done

    def undo(self) -> Patch | None:
        """Takes back the last stroke: the open one, one on its way, or a finished one.

        Returns:
          The picture as it was there, None where there is nothing to take back or to show.
        """
        if self._open:
            job = self._open
            with self._lock:
                job.cancelled = True
                self._news = [p for p in self._news if p.stroke != job.number]
            self._lift()
            return self._uncover(job.number)
        with self._lock:
            job = self._strokes[-1] if self._strokes else None
            if job is None or (job not in self._waiting and job not in self._history):
                return None
            self._strokes.pop()
            self._news = [p for p in self._news if p.stroke != job.number]
            finished = job not in self._waiting
            if finished:
                self._history.pop()
                if job.box is not None:
                    self._canvas = with_part(self._canvas, job.box, job.before)
            else:
                job.cancelled = True
                self._waiting.remove(job)
                self._idle.notify_all()
        if finished and job.box is not None:
            corner = tuple(s.start for s in job.box)
            self._screen.show(corner, job.before, job.number)
            return Patch(job.number, corner, job.before, True)
        return self._uncover(job.number)

    def record(self) -> Recording:
        """The strokes so far, those taken back left out."""
        events, brush, color = [], None, None
        for job in self._strokes:
            event = {**job.event, "load": job.load}
            if event != brush:
                events.append(BrushEvent(event))
            if job.color != color:
                events.append(ColorEvent(job.color))
            brush, color = event, job.color
            s = {n: tuple(float(v) for v in job.samples[n]) for n in FIELDS}
            events.append(StrokeEvent(s["time"], *(s[n] for n in FIELDS[1:])))
        h, w = self._canvas.height.shape
        side = self.options.pixel
        return Recording((w * side, h * side), 1.0, tuple(events))

    def close(self):
        """Ends the open stroke, waits for the networks, and stops the thread."""
        if self._closed:
            return
        if self._open:
            self.end()
        self._closed = True
        self._queue.put(None)
        self._worker.join()

    def _lift(self):
        self._open, self._pen = None, None
        self._lifted.set()

    def _preview(self, track, bounds) -> Patch | None:
        job = self._open
        box = painter.place_piece(self.options, self._shape, bounds)
        if box is None:
            return None
        cover, corner = painter.covered(self.options, box, track)
        found = self._screen.cover(job.number, np.asarray(cover), corner, PREVIEW_FILM, job.color)
        return Patch(job.number, *found, False) if found else None

    def _uncover(self, number: int) -> Patch | None:
        found = self._screen.uncover(number, self._canvas)
        return Patch(number, *found, False) if found else None

    def _work(self):
        while (item := self._queue.get()) is not None:
            job, piece = item
            if job.cancelled:
                continue
            try:
                if piece is not None:
                    self._paint_left(job, piece)
                    continue
                self._lifted.wait()
                new, box = self._paint_job(job)
            except Exception as error:  # whatever it is, the painter must be told and go on
                job.error = error
                if piece is not None:
                    continue
                new, box = None, None
            with self._lock:
                if not job.cancelled:
                    self._finish(job, self._canvas, new, box)
                    self._waiting.remove(job)
                    self._idle.notify_all()
            job.stream = None

    def _paint_left(self, job: _Job, piece):
        """Paints what the brush has left, where the stroke is long."""
        if job.error:
            return
        if job.stream is None:
            # Strokes before this one are done: the queue keeps their order.
            color = np.asarray(job.color, np.float32)
            job.stream = Stream(self.options, self._nets, self._canvas, color)
        job.stream.add(*piece)
        if not (job.long and job.stream.fits):
            return
        for cell in job.stream.left():
            corner, part = job.stream.paint(cell)
            with self._lock:
                if job.cancelled:
                    return
                self._news.append(Patch(job.number, corner, part, False))

    def _paint_job(self, job: _Job):
        """(Canvas, slices that the stroke may change) of a stroke that is ended."""
        if job.error:
            raise job.error
        stream = job.stream if job.stream is not None and job.stream.fits else None
        if job.long and stream is not None:
            box = painter.reached(self._shape, stream.bounds)
            return stream.result(self._lifted.wait), box
        box = []

        def watch(stage, value):
            if stage == "brush":
                box.append(painter.reached(self._shape, value[1]))
            jax.block_until_ready(value)
            self._lifted.wait()

        color = np.asarray(job.color, np.float32)
        given = self.options, self._nets, self._canvas
        if stream is not None:
            found = stream.track(), stream.bounds
            watch("brush", found)
            new = painter.paint_track(*given, *found, color, watch=watch)
        else:
            new = self._paint(*given, job.brush, color, job.stroke, watch=watch,
                              load=job.load)  # fmt: skip
        return jax.block_until_ready(new), box[0] if box else None

    def _finish(self, job: _Job, before: Canvas, after: Canvas | None, box):
        # All of its preview goes, wherever that was.
        box = self._screen.extent(job.number, box)
        if after is None and box is not None:
            # What was shown stays, so that no stroke is lost.
            part, mine = part_of(before, box), self._screen.owner[box] == job.number
            part.height[mine] = self._screen.canvas.height[box][mine]
            part.color[mine] = self._screen.canvas.color[box][mine]
            after = with_part(before, box, part)
        self._history.append(job)
        if after is None or box is None:
            return
        job.box, job.before = box, part_of(before, box)
        self._canvas = after
        corner = tuple(s.start for s in box)
        self._news.append(Patch(job.number, corner, part_of(after, box), True, job.error))
