"""Exact trajectory maps: of all sweeps over a pixel the latest, whatever the order of work.

Every sweep that covers a pixel offers the key stamp * bristles + bristle + 1, and the largest key
stays: a maximum, so the result does not depend on the order, and equal times are settled by the
bristle's number. The values are then looked up once a pixel.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.raster.sweeps import FAR, Sweeps, before, exit_share, nearest

LANES = 8
"""Windows are a multiple of this wide [pixels]: whole vector registers."""
LARGEST_KEY = 2**31 - 1


def window_side(radius: float) -> int:
    """Pixels along a side of the window that a piece of a sweep is drawn in, radius [pixels]."""
    return LANES * int(np.ceil((2.0 * radius + 4.0) / LANES))


def table_of(sweeps: Sweeps):
    """The fields of sweeps as rows (t * b, 13): one look-up for each window or pixel.

    What touches nothing is moved far away.
    """
    far = dataclasses.replace(sweeps, x=jnp.where(sweeps.depth > 0.0, sweeps.x, FAR))
    return jnp.stack([x.reshape(-1) for x in jax.tree.leaves(far)], axis=1)


def _row(table, number):
    """Sweeps of the rows `number` of a table, fields shaped like `number`."""
    row = table[number]
    return Sweeps(*(row[..., k] for k in range(row.shape[-1])))


def _pieces(sweeps: Sweeps, longest: float):
    """How many windows each sweep needs, at least 1."""
    length = jnp.maximum(jnp.abs(sweeps.ex), jnp.abs(sweeps.ey))
    count = jnp.ceil(length / longest)
    # A sweep without finite ends draws nothing.
    count = jnp.where((sweeps.depth > 0.0) & (count < FAR), count, 1.0)
    return jnp.maximum(count, 1.0).astype(jnp.int32)


def _corners(sweeps: Sweeps, piece, pieces, radius, side, shape):
    """First pixel of the window around piece number `piece`, in the padded image, and whether
    that window lies in it: (y, x, inside)."""

    def first(start, span, size):
        share = 1.0 / pieces.astype(start.dtype)
        a = start + span * (share * piece)
        b = start + span * (share * (piece + 1))
        at = jnp.ceil(jnp.minimum(a, b) - radius)
        # Clipped before it becomes an integer, and by hand: what lies off the image counts as
        # outside instead of being moved in.
        clipped = jnp.clip(at, -side, size)
        return clipped.astype(jnp.int32) + side, at == clipped

    y, iny = first(sweeps.y, sweeps.ey, shape[0])
    x, inx = first(sweeps.x, sweeps.ex, shape[1])
    return y, x, iny & inx & (piece < pieces.astype(sweeps.x.dtype))


def _nearest(sweep: Sweeps, y, x, side):
    """(share, square distance) of a sweep next to the pixels of the window at y, x."""
    index = jnp.arange(side, dtype=sweep.x.dtype)
    return nearest(
        sweep, (x.astype(index.dtype) + index)[None], (y.astype(index.dtype) + index)[:, None]
    )


def _paint_loop(image, offers, corner, live, side, combine):
    """One window after the other, only those that are `live`: the fastest way on a CPU."""

    def collect(number, carry):
        order, count = carry
        entry = jnp.full((1,), number, jnp.int32)
        order = jax.lax.dynamic_update_slice(order, entry, (count,))
        return order, count + live[number].astype(jnp.int32)

    # One scalar loop: 4 times faster here than jnp.nonzero.
    start = (jnp.zeros(live.shape, jnp.int32), jnp.zeros((), jnp.int32))
    order, count = jax.lax.fori_loop(0, live.shape[0], collect, start)

    def body(k, image):
        i = order[k]
        y, x = corner[i, 0], corner[i, 1]
        new = offers(i, y - side, x - side)
        old = jax.lax.dynamic_slice(image, (y, x), (side, side))
        return jax.lax.dynamic_update_slice(image, combine(old, new), (y, x))

    return jax.lax.fori_loop(0, count, body, image)


def _paint_scatter(image, offers, corner, side, scatter):
    """All windows at once: the fastest way on a GPU."""
    index = jnp.arange(corner.shape[0])
    new = jax.vmap(offers)(index, corner[:, 0] - side, corner[:, 1] - side)
    numbers = jax.lax.ScatterDimensionNumbers(
        update_window_dims=(1, 2), inserted_window_dims=(), scatter_dims_to_operand_dims=(0, 1)
    )
    mode = jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS
    return scatter(image, corner, new, numbers, mode=mode)


def _draw(sweeps: Sweeps, offers_of, shape, radius: float, combine, scatter, platform=None):
    """Draws all sweeps (t, b) into an int32 image of `shape` by `combine`.

    The first piece of every sweep is drawn in one go; sweeps longer than a window are few, and
    their further pieces are drawn stamp by stamp.
    """
    side = window_side(radius)
    longest = side - 0.5 - 2.0 * radius
    stamps, count = sweeps.x.shape
    pieces = _pieces(sweeps, longest)
    image = jnp.zeros((shape[0] + 2 * side, shape[1] + 2 * side), jnp.int32)

    def draw(image, some, numbers, piece, pieces):
        y, x, inside = _corners(some, piece, pieces, radius, side, shape)
        corner = jnp.stack([y.reshape(-1), x.reshape(-1)], axis=1)
        live = (inside & (some.depth > 0.0)).reshape(-1)
        offers = offers_of(numbers.reshape(-1), live, piece, pieces.reshape(-1))
        loop = lambda image: _paint_loop(image, offers, corner, live, side, combine)  # noqa: E731
        spread = lambda image: _paint_scatter(image, offers, corner, side, scatter)  # noqa: E731
        if platform is not None:
            return (loop if platform == "cpu" else spread)(image)
        return jax.lax.platform_dependent(image, cpu=loop, default=spread)

    numbers = jnp.arange(stamps * count, dtype=jnp.int32).reshape(stamps, count)
    image = draw(image, sweeps, numbers, jnp.zeros((), sweeps.x.dtype), pieces)

    further = jnp.max(pieces, axis=1) - 1
    ends = jnp.cumsum(further)

    def more(carry):
        return carry[0] < ends[-1]

    def one(carry):
        done, image = carry
        stamp = jnp.sum((ends <= done).astype(jnp.int32))
        piece = (done - (ends[stamp] - further[stamp]) + 1).astype(sweeps.x.dtype)
        row = lambda x: jax.lax.dynamic_slice_in_dim(x, stamp, 1)  # noqa: E731
        some = jax.tree.map(row, sweeps)
        return done + 1, draw(image, some, row(numbers), piece, row(pieces))

    _, image = jax.lax.while_loop(more, one, (jnp.zeros((), ends.dtype), image))
    return image[side : side + shape[0], side : side + shape[1]]


def latest(sweeps: Sweeps, table, shape, radius: float, platform=None):
    """Key of the latest sweep over each pixel, (h, w) int32: 1 + stamp * bristles + bristle, 0
    where there is none.

    Args:
      sweeps: (t, b); table: their rows. shape: (h, w). radius: of a bristle [pixels].
      platform: "cpu" draws in a loop, "gpu" by a scatter, None by what runs it.
    """
    side = window_side(radius)

    def offers_of(numbers, live, piece, pieces):
        keys = jnp.where(live, numbers + 1, 0)

        def offers(i, y, x):
            _, square = _nearest(_row(table, numbers[i]), y, x, side)
            return jnp.where(square <= radius * radius, keys[i], 0)

        return offers

    return _draw(sweeps, offers_of, shape, radius, jnp.maximum, jax.lax.scatter_max, platform)


def passes(sweeps: Sweeps, table, shape, radius: float, platform=None):
    """How many times a bristle came over each pixel, (h, w) int32.

    A bristle that stays over a pixel from stamp to stamp counts once.
    """
    side = window_side(radius)
    old = table_of(before(sweeps))

    def offers_of(numbers, live, piece, pieces):
        def offers(i, y, x):
            share, square = _nearest(_row(table, numbers[i]), y, x, side)
            _, earlier = _nearest(_row(old, numbers[i]), y, x, side)
            # Windows of neighbouring pieces overlap; a pixel counts in that of its nearest point.
            count = pieces[i].astype(share.dtype)
            own = jnp.minimum(jnp.floor(share * count), count - 1.0) == piece
            new = (square <= radius * radius) & (earlier > radius * radius)
            return (new & own & live[i]).astype(jnp.int32)

        return offers

    return _draw(sweeps, offers_of, shape, radius, jnp.add, jax.lax.scatter_add, platform)


def values(table, key, radius: float):
    """Force [µN] and time at which the latest sweep left each pixel, 0 where `key` is 0.

    Differentiable in what the sweeps carry, not in which of them is the latest.

    Returns:
      (force, time), each (h, w).
    """
    own = _row(table, jnp.maximum(key - 1, 0))
    y = jnp.arange(key.shape[0], dtype=table.dtype)[:, None]
    x = jnp.arange(key.shape[1], dtype=table.dtype)[None, :]
    share = exit_share(own, x, y, radius)
    there = key > 0
    force = jnp.where(there, own.press + share * own.gain, 0.0)
    return force, jnp.where(there, own.time + share * own.span, 0.0)


def check_keys(stamps: int, bristles: int):
    """Raises ValueError when keys do not fit 31 bits."""
    if stamps * bristles + 1 > LARGEST_KEY:
        raise ValueError(
            f"{stamps} stamps x {bristles} bristles: expected fewer than 2^31 sweeps in a stroke"
        )
