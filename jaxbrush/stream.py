"""A long stroke painted while the pen is down: patch by patch, what the brush has left.

This takes networks that see what is near a pixel and nothing else, without normalisation: a patch
with enough around its core is then painted as it would be as part of the whole stroke.
"""

import collections
import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush import painter, patches, stages
from jaxbrush.canvas import Canvas
from jaxbrush.film import Laid, dipped, lay_on
from jaxbrush.loaded import REACH
from jaxbrush.painter import Nets, PainterConfig
from jaxbrush.patches import PatchConfig, Rect

PATCHES = PatchConfig(192, 80)
"""The color network sees up to 15 pixels before and 24 behind of a height that has seen as much
itself, twice what one network sees."""
AROUND = 10
"""Pixels around the tips in which hair lies in paint, and bilinear columns."""
BORDER = PATCHES.size
"""Pixels of film beyond the canvas: patches of it end there."""
SIDES = (128, 256, 512, 1024)
"""Sides of the rectangles that a piece lays its film in [pixels]."""


def local(nets: Nets) -> bool:
    """Whether both networks see what is near a pixel and nothing else."""
    return all(c.norm in ("none", "batch") for c in (nets.height_config, nets.color_config))


def _core(options: PainterConfig, nets: Nets, canvas: Canvas, drawn, corner) -> Canvas:
    """The core of a patch as it will be, (step, step)."""
    lead, step = PATCHES.lead, PATCHES.step
    rect = Rect(corner=corner, sides=(PATCHES.size,) * 2)
    pairs = stages.cut(options, rect, drawn, canvas, rect)
    painted = stages.evaluate(options, nets, pairs, rect)
    inside = lambda x: x[..., lead : lead + step, lead : lead + step, :]  # noqa: E731
    under = lambda x: patches.cut_canvas(x, corner[None] + lead, (step, step))[0]  # noqa: E731
    own = Rect(corner=jnp.zeros_like(corner), sides=(step, step))
    part = Canvas(height=under(canvas.height), color=under(canvas.color))
    drawn = dataclasses.replace(drawn, share=inside(drawn.share))
    return stages.lay(options, own, drawn, part, own, inside(painted))


_paint = jax.jit(_core)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _lay_on(pixel, canvas, corner, track, laid: Laid) -> Laid:
    grid = patches.grid_of(PATCHES, Rect(corner=corner, sides=laid.film.shape), pixel)
    return lay_on(grid, track, track.hairs[0], canvas, laid, track.relief[0])


class Film:
    """The film of a stroke that goes on, on all of the canvas and `BORDER` around it.

    Args:
      height: of the canvas before [mm]. track: of some of its stamps, from `stages.trace`.
    """

    def __init__(self, pixel: float, height, track):
        self.pixel, self.canvas = pixel, height.shape
        self.film = np.pad(np.asarray(height), BORDER, mode="edge")
        self.hair = np.zeros_like(self.film)
        bristles = track.position.shape[-1]
        # Of the stamps so far; what it says of pixels is that of the last rectangle.
        self.laid = dipped(pixel, self.film[:1, :1], bristles, track.hairs[0], track.load[0])

    def add(self, track):
        """Goes on with the next stamps; the first is the last one of before, if there was one."""
        tip = track.position[track.valid][:, -1, :2] / self.pixel
        if not len(tip):
            return
        low = np.floor(tip.min((0, 2)))[::-1].astype(int) - AROUND
        high = np.ceil(tip.max((0, 2)))[::-1].astype(int) + AROUND
        end = np.add(self.canvas, BORDER)
        sides = [painter.bucket(n, SIDES) for n in high - low]
        sides = np.minimum(sides, self.film.shape)
        at = np.clip(low, -BORDER, end - sides)
        here = self._here(at, sides)
        laid = dataclasses.replace(self.laid, film=self.film[here], hair=self.hair[here])
        laid = jax.device_get(_lay_on(self.pixel, self.canvas, at.astype(np.int32), track, laid))
        self.film[here], self.hair[here], self.laid = laid.film, laid.hair, laid

    def on(self, corner, sides):
        """(film, hair) on a rectangle of the canvas."""
        here = self._here(corner, sides)
        return self.film[here], self.hair[here]

    def _here(self, corner, sides):
        return tuple(slice(a + BORDER, a + BORDER + n) for a, n in zip(corner, sides, strict=True))


def _cells(low, high):
    """Numbers of the patches from that of one pixel y, x to that of another."""
    first, last = ((np.asarray(x, int)) // PATCHES.step for x in (low, high))
    return [(y, x) for y in range(first[0], last[0] + 1) for x in range(first[1], last[1] + 1)]


class Stream:
    """One stroke on its way, and the patches of it that are painted; everything by one thread.

    Args:
      canvas: before the stroke. color: (3,) of the paint, linear RGB.
    """

    def __init__(self, options: PainterConfig, nets: Nets, canvas: Canvas, color):
        self.options, self.nets, self.canvas, self.color = options, nets, canvas, color
        self.bounds = np.zeros((0, 4), np.float32)
        self._tracks, self._stamps, self._latest = [], 0, 0
        self._film: Film | None = None
        self._bare = []  # pieces that have not laid their film: only a long stroke needs it
        self._wanted: set[tuple[int, int]] = set()
        self._touched = collections.defaultdict(int)  # stamps of the stroke when it last came there
        self._painted: dict[tuple[int, int], tuple[int, Canvas]] = {}

    def add(self, track, bounds):
        """The next piece, final, of stamps that follow the last piece's; its first is that."""
        track, bounds = jax.device_get((track, bounds))
        painter.reached(self.canvas.height.shape, bounds)  # refuses what is not finite
        new = slice(1 if self._tracks else 0, int(track.valid.sum()))
        fresh = track.valid.copy()
        fresh[: new.start] = False
        self._bare.append(dataclasses.replace(track, valid=fresh))
        track, bounds = jax.tree.map(lambda x: x[new], track), bounds[new]
        self.bounds = np.concatenate([self.bounds, bounds])
        self._tracks.append(track)
        self._latest = self._stamps
        self._stamps += len(bounds)
        shape = self.canvas.height.shape
        low, high = bounds[:, :2] - REACH, bounds[:, 2:] + REACH - 1
        off = (high < 0).any(1) | (low >= shape).any(1) | (high < low).any(1)
        # Patch i goes from i * step - overlap to before (i + 1) * step; its core starts lead later.
        for a, b in np.unique(np.stack([low, high], 1)[~off].astype(int), axis=0):
            for cell in _cells(a, b + PATCHES.overlap):
                self._touched[cell] = self._stamps
            shift = PATCHES.overlap - PATCHES.lead
            inside = np.maximum(a, 0) + shift, np.minimum(b, np.subtract(shape, 1)) + shift
            self._wanted.update(_cells(*inside))

    def left(self, end: bool = False) -> list[tuple[int, int]]:
        """Patches to paint now: those that the last piece did not touch, or all at the end."""
        now = self._stamps if end else self._latest
        return sorted(
            cell for cell in self._wanted
            if self._touched[cell] <= now
            and self._painted.get(cell, (0,))[0] < self._touched[cell]
        )  # fmt: skip

    def paint(self, cell) -> tuple[tuple[int, int], Canvas]:
        """Paints a patch as far as the stroke has come; the part that is its core, on the canvas,
        and its first pixel."""
        corner = np.asarray(cell, np.int32) * PATCHES.step - PATCHES.overlap
        shape = self.canvas.height.shape
        if cell not in self._painted or self._painted[cell][0] < self._touched[cell]:
            rect = Rect(corner=jnp.asarray(corner), sides=(PATCHES.size,) * 2)
            laid = self._laid().on(corner, rect.sides)
            drawn, _ = painter.draw_on(
                self.options, rect, self.canvas, self.track(), self.color, laid
            )
            part = _paint(self.options, self.nets, self.canvas, drawn, rect.corner)
            self._painted[cell] = self._stamps, jax.device_get(part)
        first = corner + PATCHES.lead
        low, high = np.maximum(first, 0), np.minimum(first + PATCHES.step, shape)
        at = tuple(slice(a, b) for a, b in zip(low - first, high - first, strict=True))
        return tuple(int(x) for x in low), jax.tree.map(lambda x: x[at], self._painted[cell][1])

    def _laid(self) -> Film:
        """The film of the stroke so far."""
        if self._film is None:
            self._film = Film(self.options.pixel, self.canvas.height, self._tracks[0])
        for track in self._bare:
            self._film.add(track)
        self._bare = []
        return self._film

    def result(self, pause=lambda: None) -> Canvas:
        """The canvas with the whole stroke. pause: called before each patch yet to be painted."""
        for cell in self.left(end=True):
            pause()
            self.paint(cell)
        height, color = np.array(self.canvas.height), np.array(self.canvas.color)
        for cell in self._wanted:
            (y, x), part = self.paint(cell)
            h, w = part.height.shape
            height[y : y + h, x : x + w] = part.height
            color[y : y + h, x : x + w] = part.color
        return Canvas(height=jnp.asarray(height), color=jnp.asarray(color))

    @property
    def fits(self) -> bool:
        """Whether there are no more stamps than the largest bucket."""
        return self._stamps <= max(self.options.stamps)

    def track(self):
        """The track so far, with a bucket of stamps; those that are padding are not valid.

        Raises:
          ValueError: there are too many.
        """
        self._tracks = [jax.tree.map(lambda *x: np.concatenate(x), *self._tracks)]
        track = self._tracks[0]
        room = painter.bucket(self._stamps, self.options.stamps) - self._stamps
        if not self.fits:
            raise ValueError(
                f"a stroke of {self._stamps} stamps: expected at most {max(self.options.stamps)}, "
                "the largest of stamps"
            )
        longer = jax.tree.map(lambda x: np.concatenate([x, np.repeat(x[-1:], room, 0)]), track)
        longer.valid[self._stamps :] = False
        return longer
