"""Where maps are drawn: a window of pixels on the canvas, in bucketed sizes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.structs import state

PIXEL = 0.1
"""Default side of a pixel [mm]."""
BUCKETS = (64, 256, 512, 768, 1024, 1536, 2048)
"""Sides of the windows that strokes are drawn in, so that a session compiles few shapes: 4 to 6 for
30 random strokes, whose windows are twice as large as need be. With buckets 1.3 to 1.5 times apart
it is 17 to 19 shapes, and 1.4 times."""


@state
class Grid:
    """A window of h x w pixels on the canvas.

    shape: (h, w), static. origin: (2,) x, y of the outer corner of its first pixel [mm].
    pixel: side of a pixel [mm], static.
    """

    shape: tuple[int, int] = dataclasses.field(metadata={"static": True})
    origin: jax.Array
    pixel: float = dataclasses.field(default=PIXEL, metadata={"static": True})


def make_grid(shape, origin=(0.0, 0.0), pixel: float = PIXEL) -> Grid:
    """A window of `shape` (h, w) pixels whose outer corner is `origin` (x, y) [mm].

    Raises:
      ValueError: a side below 1 pixel, an origin that is not two numbers, or a pixel that is not
        positive.
    """
    h, w = (int(n) for n in shape)
    if h < 1 or w < 1:
        raise ValueError(f"shape = {tuple(shape)}: expected (height, width) of at least 1 pixel")
    if not pixel > 0.0:
        raise ValueError(f"pixel = {pixel!r}: expected a positive side [mm]")
    origin = jnp.asarray(origin, float)
    if origin.shape != (2,):
        raise ValueError(f"origin has shape {origin.shape}: expected (x, y) [mm]")
    return Grid(shape=(h, w), origin=origin, pixel=float(pixel))


def bucket(size: int) -> int:
    """The smallest bucketed side that holds `size` pixels.

    Raises:
      ValueError: more pixels than the largest bucket.
    """
    for side in BUCKETS:
        if size <= side:
            return side
    raise ValueError(f"a stroke of {size} pixels: expected at most {BUCKETS[-1]} along a side")


def stroke_grid(track, width: float, pixel: float = PIXEL, margin: int = 4) -> Grid:
    """The bucketed window around what the bristles of a track touch; not jittable.

    Its origin lies on whole pixels of the canvas, so that maps of different strokes line up.

    Args:
      track: BristleTrack of one stroke.
      width: of a bristle [mm].
      pixel: [mm].
      margin: pixels kept free around it.

    Returns:
      Grid; one bucket of the smallest size at the origin when nothing touches.
    """
    place = np.asarray(track.position)[:, :, :2]
    touch = np.asarray(track.contact)
    if not touch.any():
        return make_grid((BUCKETS[0], BUCKETS[0]), pixel=pixel)
    # A sweep begins and ends between the stamps around a contact.
    touch = touch.copy()
    touch[1:] |= touch[:-1]
    touch[:-1] |= touch[1:]
    touch &= np.asarray(track.valid)[:, None, None]
    at = np.moveaxis(place, 2, -1)[touch]
    low = np.floor((at.min(0) - 0.5 * width) / pixel).astype(int) - margin
    high = np.ceil((at.max(0) + 0.5 * width) / pixel).astype(int) + margin
    sides = [bucket(int(n)) for n in high - low]
    # The stroke sits in the middle of its window.
    low = low - (np.array(sides) - (high - low)) // 2
    return make_grid((sides[1], sides[0]), low * pixel, pixel)


def dilate(mask, radius: int):
    """A mask (h, w) or map in [0, 1] grown by a square of `radius` pixels (maximum over it)."""

    def along(x, axis):
        done = 1
        while done < 2 * radius + 1:
            shift = min(done, 2 * radius + 1 - done)
            n = x.shape[axis] - shift
            near, far = (jax.lax.slice_in_dim(x, k, k + n, axis=axis) for k in (0, shift))
            x = jnp.maximum(near, far)
            done += shift
        return x

    if radius < 0:
        raise ValueError(f"radius = {radius}: expected at least 0 pixels")
    return along(along(jnp.pad(jnp.asarray(mask), radius), 0), 1)
