"""What a painter sees: the finished picture, with what is not finished over it."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.canvas import Canvas


def part_of(canvas: Canvas, at) -> Canvas:
    """A copy of a part, at (y, x) slices; of numpy arrays."""
    # Cut on the host: a slice on the device would compile for every new size.
    return jax.tree.map(lambda x: np.asarray(x)[at].copy(), canvas)


def with_part(canvas: Canvas, at, part: Canvas) -> Canvas:
    """The canvas with a part in place of what was there."""

    def put(x, new):
        x = np.array(x)
        x[at] = new
        return jnp.asarray(x)

    return jax.tree.map(put, canvas, part)


class Screen:
    """canvas: of numpy arrays, as it shows. owner: (h, w) number of the latest stroke that is over
    a pixel and not finished, 0 where none is."""

    def __init__(self, canvas: Canvas):
        self.canvas = Canvas(np.array(canvas.height), np.array(canvas.color))
        self.owner = np.zeros(canvas.height.shape, np.int32)

    def cover(self, number: int, cover, corner, film: float, color):
        """Lays a film of paint of a stroke where `cover` (h, w), at `corner` (y, x), is True.

        Returns:
          (first pixel, what shows there now), None where nothing of it is on the canvas.
        """
        corner = np.asarray(corner)
        low = np.maximum(corner, 0)
        high = np.minimum(corner + cover.shape, self.owner.shape)
        cover = cover[tuple(slice(*x) for x in np.stack([low, high], 1) - corner[:, None])]
        if not cover.any():
            return None
        at = tuple(slice(*x) for x in np.stack([low, high], 1))
        height = self.canvas.height[at]
        height[cover] = np.maximum(height[cover], film)
        self.canvas.color[at][cover] = color
        self.owner[at][cover] = number
        return tuple(int(x) for x in low), part_of(self.canvas, at)

    def show(self, corner, part: Canvas, number: int, final: bool = True):
        """Puts a part where no later stroke is; what is not final can be taken away again."""
        at = tuple(slice(c, c + n) for c, n in zip(corner, part.height.shape, strict=True))
        self._put(at, part, self.owner[at] <= number, 0 if final else number)

    def uncover(self, number: int, below: Canvas):
        """Takes what is not finished of a stroke away; as `cover`."""
        at = self.extent(number)
        if at is None:
            return None
        self._put(at, part_of(below, at), self.owner[at] == number, 0)
        return tuple(int(s.start) for s in at), part_of(self.canvas, at)

    def extent(self, number: int, at=None):
        """The (y, x) slices round a stroke that is not finished and round `at`; None if there is
        neither."""
        found = np.nonzero(self.owner == number)
        if not found[0].size:
            return at
        ends = [(int(x.min()), int(x.max()) + 1) for x in found]
        if at is not None:
            ends = [(min(a, s.start), max(b, s.stop)) for (a, b), s in zip(ends, at, strict=True)]
        return tuple(slice(*e) for e in ends)

    def _put(self, at, part: Canvas, take, owner: int):
        self.canvas.height[at][take] = part.height[take]
        self.canvas.color[at][take] = part.color[take]
        self.owner[at][take] = owner
