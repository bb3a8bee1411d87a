"""Exact trajectory maps: of all sweeps over a pixel the one that leaves it last, by a maximum.

Every sweep that covers a pixel offers the key

  (stamp * MOMENTS + moment) * bristles + bristle + 1,

where moment says in which part of the time between two stamps the bristle leaves the pixel. The
largest key stays, so the result does not depend on the order of work, and equal times are settled
by the bristle's number. The values are then looked up once a pixel.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.raster.sweeps import FAR, Sweeps
from jaxbrush.structs import state

MOMENTS = 64
"""Parts of the time between two stamps. The pressure of a flick of 0.45 mm a stamp is 5 % rms off
that of 8 times finer stamps; with 16 parts 11 %, with 256 3 %, in order of the bristles 41 %."""
LANES = 8
"""Windows are a multiple of this wide [pixels]: whole vector registers."""
LARGEST_KEY = 2**31 - 1
SHORTEST = 1e-4
"""Length that a sweep has at least [pixels]: a bristle at rest has a direction, too."""


@state
class Rows:
    """What draws a sweep: one row of a table, in this order, so that one look-up finds all of it.

    x, y: where it starts [pixels]. ux, uy: its direction. low, high: from where to where along it
    the bristle touches [pixels]. rate: 1 over its length. pieces: how many windows it takes, 0 if
    it draws nothing. press, gain: force at its start and the change along it [µN].
    """

    x: jax.Array
    y: jax.Array
    ux: jax.Array
    uy: jax.Array
    low: jax.Array
    high: jax.Array
    rate: jax.Array
    pieces: jax.Array
    press: jax.Array
    gain: jax.Array


def window_sides(radius: float) -> tuple[int, int]:
    """(rows, columns) of the window that a piece of a sweep is drawn in, radius [pixels]."""
    columns = LANES * int(np.ceil((2.0 * radius + 4.0) / LANES))
    # XLA unrolls a row of one register and then works on registers of rows: other than 8 of them
    # are 3 times slower. Wider windows may have as many rows as they need.
    rows = LANES if columns == LANES else int(np.ceil(2.0 * radius)) + 5
    return rows, columns


def table_of(sweeps: Sweeps, radius: float):
    """Rows of sweeps (t, b), (t * b, 10)."""
    square = sweeps.ex * sweeps.ex + sweeps.ey * sweeps.ey
    moves = square > SHORTEST**2
    rate = jnp.where(moves, 1.0 / jnp.sqrt(jnp.where(moves, square, 1.0)), 1.0 / SHORTEST)
    length = jnp.where(moves, square * rate, SHORTEST)
    tall, wide = window_sides(radius)
    reach = sweeps.high - sweeps.low
    count = jnp.maximum(
        jnp.abs(sweeps.ey) * reach / (tall - 0.5 - 2.0 * radius),
        jnp.abs(sweeps.ex) * reach / (wide - 0.5 - 2.0 * radius),
    )
    draws = sweeps.depth > 0.0
    rows = Rows(
        x=jnp.where(draws, sweeps.x, FAR),
        y=sweeps.y,
        ux=jnp.where(moves, sweeps.ex * rate, 1.0),
        uy=jnp.where(moves, sweeps.ey * rate, 0.0),
        low=sweeps.low * length,
        high=sweeps.high * length,
        rate=rate,
        pieces=jnp.where(draws, jnp.maximum(jnp.ceil(count), 1.0), 0.0),
        press=sweeps.press,
        gain=sweeps.gain,
    )
    # Stacked before it is made flat: XLA takes twice as long the other way round.
    table = jnp.stack(jax.tree.leaves(rows), axis=-1)
    return table.reshape(-1, table.shape[-1])


def _rows(table, number):
    """Rows `number` of a table, fields shaped like `number`."""
    found = table[number]
    return Rows(*(found[..., k] for k in range(found.shape[-1])))


def _span(row: Rows, piece):
    """From where to where along a sweep its piece number `piece` goes [pixels]."""
    step = (row.high - row.low) / jnp.maximum(row.pieces, 1.0)
    return row.low + step * piece, row.low + step * (piece + 1.0)


def _corner(row: Rows, piece, radius, sides, shape):
    """First pixel of the window around a piece of a sweep, in the padded image, and whether that
    window lies in it: (y, x, inside)."""
    near, far = _span(row, piece)

    def first(start, along, side, size):
        at = jnp.ceil(start + jnp.where(along > 0.0, along * near, along * far) - radius)
        # Clipped before it becomes an integer, and by hand: what lies off the image counts as
        # outside instead of being moved in.
        clipped = _between(at, -1.0 * side, 1.0 * size)
        return clipped.astype(jnp.int32) + side, at == clipped

    y, iny = first(row.y, row.uy, sides[0], shape[0])
    x, inx = first(row.x, row.ux, sides[1], shape[1])
    return y, x, iny & inx


def _between(x, low, high):
    """x in [low, high]. Without the care that jnp.clip takes of NaN it is two instructions."""
    x = jnp.where(x > low, x, low)
    return jnp.where(x < high, x, high)


def _frame(row: Rows, y, x, sides):
    """Pixels of the window at y, x of the padded image as a sweep sees them.

    Returns:
      (along, held, aside): how far along it they are, the same held to where it touches [pixels],
      and the square of how far beside it [pixels^2].
    """
    index = lambda side: jnp.arange(side, dtype=row.x.dtype)  # noqa: E731
    rx = ((x - sides[1]).astype(row.x.dtype) + index(sides[1]) - row.x)[None]
    ry = ((y - sides[0]).astype(row.x.dtype) + index(sides[0]) - row.y)[:, None]
    along, across = rx * row.ux + ry * row.uy, rx * row.uy - ry * row.ux
    return along, _between(along, row.low, row.high), across * across


def _collect(live):
    """Indices of what is live, first of (n,), and how many they are."""

    def collect(number, carry):
        order, count = carry
        entry = jnp.full((1,), number, jnp.int32)
        order = jax.lax.dynamic_update_slice(order, entry, (count,))
        return order, count + live[number].astype(jnp.int32)

    # One scalar loop: 4 times faster here than jnp.nonzero.
    start = (jnp.zeros(live.shape, jnp.int32), jnp.zeros((), jnp.int32))
    return jax.lax.fori_loop(0, live.shape[0], collect, start)


def _draw(table, stamps, images, shape, radius: float, platform):
    """Draws all sweeps of a table into int32 images of `shape`.

    Args:
      images: (offers, combine, scatter) of each: `offers(number, row, piece, y, x)` makes the
        window at y, x of a piece of a sweep, `combine` lays it over an image, `scatter` many.

    The first piece of every sweep is drawn in one go; sweeps longer than a window are few, and
    their further pieces are drawn stamp by stamp.
    """
    sides = window_sides(radius)
    bristles = table.shape[0] // stamps
    padded = [n + 2 * side for n, side in zip(shape, sides, strict=True)]

    def draw(drawn, number, rows, piece):
        count = rows.x.shape[0]
        tops, lefts, inside = _corner(rows, piece, radius, sides, shape)
        live = inside & (piece < rows.pieces)

        def window(offers, i):
            # Corners looked up, not worked out again: a quarter less.
            y, x = tops[i], lefts[i]
            return offers(number + i, _rows(table, number + i), piece, y, x), y, x

        def loop(drawn):
            """One window after the other, only those that are live: the fastest on a CPU."""
            order, many = _collect(live)

            def one(image, offers, combine, _):
                def body(k, image):
                    new, *at = window(offers, order[k])
                    old = jax.lax.dynamic_slice(image, at, sides)
                    return jax.lax.dynamic_update_slice(image, combine(old, new), at)

                return jax.lax.fori_loop(0, many, body, image)

            # A loop for each image: both in one take 2.4 times as long.
            return [one(image, *how) for image, how in zip(drawn, images, strict=True)]

        def spread(drawn):
            """All windows at once: the fastest on a GPU."""
            numbers = jax.lax.ScatterDimensionNumbers(
                update_window_dims=(1, 2),
                inserted_window_dims=(),
                scatter_dims_to_operand_dims=(0, 1),
            )
            mode = jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS

            def one(image, offers, _, scatter):
                every = jnp.arange(count, dtype=jnp.int32)
                new, y, x = jax.vmap(lambda i: window(offers, i))(every)
                new = jnp.where(live[:, None, None], new, 0)
                return scatter(image, jnp.stack([y, x], axis=1), new, numbers, mode=mode)

            return [one(image, *how) for image, how in zip(drawn, images, strict=True)]

        if platform is not None:
            return (loop if platform == "cpu" else spread)(drawn)
        return jax.lax.platform_dependent(drawn, cpu=loop, default=spread)

    every = _rows(table, slice(None))
    drawn = [jnp.zeros(padded, jnp.int32) for _ in images]
    drawn = draw(drawn, 0, every, jnp.zeros((), table.dtype))

    further = jnp.max(every.pieces.reshape(stamps, bristles), axis=1).astype(jnp.int32) - 1
    further = jnp.maximum(further, 0)
    ends = jnp.cumsum(further)

    def more(carry):
        return carry[0] < ends[-1]

    def one(carry):
        done, drawn = carry
        stamp = jnp.sum((ends <= done).astype(jnp.int32), dtype=jnp.int32)
        piece = (done - (ends[stamp] - further[stamp]) + 1).astype(table.dtype)
        number = stamp * bristles
        some = jax.lax.dynamic_slice_in_dim(table, number, bristles)
        return done + 1, draw(drawn, number, _rows(some, slice(None)), piece)

    _, drawn = jax.lax.while_loop(more, one, (jnp.zeros((), ends.dtype), drawn))
    inner = tuple(slice(side, side + n) for n, side in zip(shape, sides, strict=True))
    return [image[inner] for image in drawn]


def images(table, stamps: int, shape, radius: float, platform=None):
    """Key of the latest sweep over each pixel, and how many times a bristle came over it.

    A bristle that stays over a pixel from stamp to stamp counts once.

    Args:
      table: from `table_of`, of that many stamps. shape: (h, w). radius: of a bristle [pixels].
      platform: "cpu" draws in a loop, "gpu" by a scatter, None by what runs it.

    Returns:
      (key, passes), each (h, w) int32, 0 where there is none.
    """
    sides = window_sides(radius)
    bristles = table.shape[0] // stamps
    number = jnp.arange(table.shape[0], dtype=jnp.int32)
    # Looked up: XLA would divide integers once a pixel, at 3 times the price of all the rest.
    firsts = number // bristles * ((MOMENTS - 1) * bristles) + number + 1

    def key(number, row, piece, y, x):
        along, held, aside = _frame(row, y, x, sides)
        square = aside + (along - held) ** 2
        leaves = along + jnp.sqrt(jnp.maximum(radius * radius - aside, 0.0))
        leaves = _between(leaves, row.low, row.high)
        moment = jnp.minimum((leaves * (MOMENTS * row.rate)).astype(jnp.int32), MOMENTS - 1)
        return jnp.where(square <= radius * radius, firsts[number] + moment * bristles, 0)

    def enters(number, row, piece, y, x):
        def inside(row):
            along, held, aside = _frame(row, y, x, sides)
            return aside + (along - held) ** 2 <= radius * radius, held

        now, held = inside(row)
        earlier, _ = inside(_rows(table, jnp.maximum(number - bristles, 0)))
        earlier &= number >= bristles  # before the first stamp there is none
        # Windows of neighbouring pieces overlap; a pixel counts in that of its nearest point.
        near, far = _span(row, piece)
        own = ((held >= near) | (piece == 0.0)) & ((held < far) | (piece + 1.0 == row.pieces))
        return (now & ~earlier & own).astype(jnp.int32)

    ways = [
        (key, jnp.maximum, jax.lax.scatter_max),
        (enters, jnp.add, jax.lax.scatter_add),
    ]
    return _draw(table, stamps, ways, shape, radius, platform)


def decode(key, bristles: int):
    """(stamp, bristle) of keys; those of the first sweep where a key is 0."""
    key = jnp.maximum(key - 1, 0)
    return key // (MOMENTS * bristles), key % bristles


def values(sweeps: Sweeps, table, key, radius: float):
    """Force [µN] and time at which the latest sweep left each pixel, 0 where `key` is 0.

    Differentiable in what the sweeps carry, not in which of them is the latest.

    Returns:
      (force, time), each (h, w).
    """
    stamp, bristle = decode(key, sweeps.x.shape[1])
    number = stamp * sweeps.x.shape[1] + bristle
    row = _rows(table, number)
    rx = jnp.arange(key.shape[1], dtype=table.dtype)[None, :] - row.x
    ry = jnp.arange(key.shape[0], dtype=table.dtype)[:, None] - row.y
    along, across = rx * row.ux + ry * row.uy, rx * row.uy - ry * row.ux
    # Near the rim the chord shrinks like a square root; it is cut off where its slope is steep.
    chord = jnp.sqrt(jnp.maximum(radius * radius - across * across, 0.1 * radius * radius))
    share = jnp.clip(along + chord, row.low, row.high) * row.rate
    there = key > 0
    time = sweeps.time[:, 0][stamp] + share * sweeps.span[:, 0][stamp]
    return jnp.where(there, row.press + share * row.gain, 0.0), jnp.where(there, time, 0.0)


def check_keys(stamps: int, bristles: int):
    """Raises ValueError when keys do not fit 31 bits."""
    if stamps * MOMENTS * bristles + 1 > LARGEST_KEY:
        raise ValueError(
            f"{stamps} stamps x {bristles} bristles: expected fewer than "
            f"{(LARGEST_KEY + 1) // MOMENTS} sweeps in a stroke"
        )
