"""The film that a stroke would leave if paint moved by hair alone, and the hair that was in it.

Hair that passes through a column of paint draws its film towards the thickness at which hair and
film are in equilibrium, as the simulator's transfer does (`jaxbrush.paint.transfer`), and takes
along what stands above it; nothing flows. That is no picture of the stroke, but it has the grooves
of single bristles, where the maps of the bristle that came last have none: at their scale (between
Gaussians of 1 and 2.5 pixels) its correlation with the simulator's heights is 0.7, median over some
60 strokes, that of the sweep count 0.0.

Bristles run dry as they do there: each holds what the brush was loaded with, lays it and takes up
what it lifts, and is refilled from behind. A dry one has a thin coat, lays little, and on a coarse
weave reaches the threads alone. With a coat as thick as at first everywhere the film is 96 µm off
the simulator (rms in the masks of those strokes), with this 77; where the brush holds next to
nothing 66 and 34. What a point on a hair touches it is told by the canvas and the film between the
middles of columns, as there: where each column tells for itself, dry strokes have the lattice of
the threads and no streaks, and all films are 5 % farther off (77.5 µm for 74 on 112 strokes).

A brush is full of paint that moves with it, two to four times as high as the film it leaves, the
more the longer it goes over wet paint, and where it lifts that stays as a ridge. No network that
sees a few millimetres knows how much it is. So each bristle takes up paint, carries it and lets go
of it, and the film has the ridge: networks then have a tenth less error (docs/networks.md).

Where hair is pressed flat all along its way, every column comes to the same film, and what is left
between the hairs is up to the flow: paint gathers where there is little hair. So the thickness of
the hair in the film is kept beside it, averaged over the last of the way.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.brush import BristleTrack
from jaxbrush.paint.state import RELIEF, TUNED_HAIRS, make_params, weave
from jaxbrush.patches import cut_canvas
from jaxbrush.raster import Grid
from jaxbrush.structs import state

ENDS = (0.0, 0.06, 0.2, 0.5, 1.0)
"""Of the lowest part of a bristle, from its tip: where the pieces end that one point each stands
for. Hair that comes down touches with its tip alone, so the points are closer there: after the same
1,000 updates networks have an error of 0.106 in the mask with these, 0.109 and 0.111 (two seeds)
with four pieces of one length and 0.107 with eight, which take twice as long; 0.111 with three (0.1
and 0.4 between them), 0.119 with two (0.2), 0.145 with one."""
MEMORY = 0.75
"""Way [mm] over which the hair in the film is averaged, with weights that fall by e in it. With
this map the height of a long pressed stroke is explained to 59, 57 and 86 % by octave, from the
finest (a linear fit), with sweep count, tips and film alone to 3, 45 and 58 %. With 0.25 mm it is
50, 50 and 71 %, with 1.5 mm 54, 58 and 85 %."""
WAKE = 5.0
"""Widths of a hair that paint is taken along in."""
BEHIND = 1.0
"""Way [mm] on which what is taken along falls behind, by e."""
STANDS = 0.5
"""Share of the film in equilibrium that is not taken along. If all of it stands, a stroke on bare
canvas has no ridge at its end, and networks have some 2 % more error; if none does, it is as with
half, but the film trembles more with the stamps."""
LIFTED = 0.5
"""Rate at which hair takes paint out of a film that is too thick, as a share of that at which it
lays. These four were chosen among a dozen by the error of networks after 1,000 updates, on the 112
test pairs of docs/networks.md."""
FULL = 1.3
"""Times what a tip holds, up to which its coat grows, as in the simulator."""


@state
class Laid:
    """What a stroke has laid so far. film: (h, w) height of the paint [mm]. hair: (h, w) volume of
    hair below the film's surface over the pixel's area [mm], averaged over the last `MEMORY` of the
    way of hair through the pixel. Of each bristle (b,), as heights over a pixel [mm]: taken, what
    it takes along; tip and behind, what it holds there and in the brush behind."""

    film: jax.Array
    hair: jax.Array
    taken: jax.Array
    tip: jax.Array
    behind: jax.Array


def dipped(pixel: float, height, bristles: int, hairs, load) -> Laid:
    """A canvas (h, w) [mm] before a stroke, by bristles that hold what the brush was loaded with;
    other arguments as in `laid_film`."""
    none = jnp.zeros(bristles, height.dtype)
    tip, behind = (none + load * most for most in _holds(pixel, hairs))
    return Laid(film=height, hair=jnp.zeros_like(height), taken=none, tip=tip, behind=behind)


def _holds(pixel: float, hairs):
    """What a bristle holds at its tip and behind, as heights over a pixel [mm]."""
    p = make_params()
    return [hairs * x / (TUNED_HAIRS * pixel**2) for x in (p.tip_volume, p.reservoir_volume)]


def laid_film(grid: Grid, track: BristleTrack, hairs, load, height, relief=RELIEF):
    """Height of the paint after a stroke that lays it, lifts it and takes it along, on the pixels
    of a grid, and the hair that was in it last.

    Differentiable in places and heights of the hair and in the canvas. What a bristle takes along
    it takes from the grid and the canvas alone: of grids that hold all that a stroke touches on a
    canvas each has the same film, to the bit.

    Args:
      grid: its origin on whole pixels of the canvas. track: of t stamps about a pixel apart, at
        least 2 nodes and b bristles. hairs: () of the simulator's constants that a bristle stands
        for. load: () share of what the brush holds. height: (y, x) of the canvas before [mm], which
        goes on beyond its edges as it is there. relief: () depth of its weave [mm].

    Returns:
      (film, hair) of `Laid`.

    Raises:
      ValueError: a track of the tips alone.
    """
    bare = cut_canvas(height, _corner(grid)[None], grid.shape)[0]
    begun = dipped(grid.pixel, bare, track.position.shape[-1], hairs, load)
    laid = lay_on(grid, track, hairs, height.shape, begun, relief)
    return laid.film, laid.hair


def _corner(grid: Grid):
    return jnp.round(grid.origin[::-1] / grid.pixel).astype(jnp.int32)


@jax.custom_jvp
def _meet(heap, last, cell, parts):
    """Sums of parts (..., n) over all that are in the same cell: (heap (cells, n), sums).

    heap: where they are added up, zero but in the cells `last`, those of the call before. Zeros
    made anew for every stamp would have its time grow as the grid: a stroke from corner to corner
    of 2048 x 2048 pixels took 3.6 times as long.
    """
    heap = heap.at[last].set(0.0).at[cell].add(parts)
    return heap, heap[cell]


@_meet.defjvp
def _meet_jvp(primals, tangents):
    heap, _, cell, _ = primals
    zero = jnp.zeros_like(heap)
    return _meet(*primals), (zero, zero.at[cell].add(tangents[3])[cell])


def lay_on(
    grid: Grid, track: BristleTrack, hairs, canvas, laid: Laid, relief=RELIEF
) -> Laid:  # fmt: skip
    """Goes on with the film of a stroke; arguments as in `laid_film`, but track: its next stamps,
    the first of which only says where the hair was. canvas: (y, x) its size, static. laid: so far,
    on the pixels of the grid, at first from `dipped`."""
    if track.position.shape[1] < 2:
        raise ValueError(f"track of {track.position.shape[1]} node: expected at least 2")
    p, pixel = make_params(), grid.pixel
    radius = p.hair_radius
    most, most_behind = _holds(pixel, hairs)
    h, w = grid.shape
    corner = _corner(grid)
    # How far below what hair lies on the cloth is.
    gap = relief - weave(grid.shape, pixel, relief, first=(corner[0], corner[1]))
    gap = jnp.append(gap.reshape(-1), 0.0).astype(laid.film.dtype)
    film = jnp.append(laid.film.reshape(-1), 0.0)  # the last: off the grid
    hair = jnp.append(laid.hair.reshape(-1), 0.0)

    share = jnp.asarray(0.5 * (np.asarray(ENDS[1:]) + np.asarray(ENDS[:-1])), film.dtype)
    piece = jnp.asarray(np.diff(ENDS), film.dtype)  # of the length
    weight = (1.0 - 0.7 * share) * piece * p.contact_area / (TUNED_HAIRS * pixel**2)
    # The hair tapers to half its cross-section at the tip.
    volume = (0.5 + 0.5 * share) * jnp.pi * radius**2 * p.hair_length * piece / pixel**2
    volume = hairs * volume[None, :, None]
    node = track.position[:, -2:].astype(film.dtype)
    up = node[:, 0] - node[:, 1]
    part = jnp.minimum(p.hair_length / jnp.sqrt(jnp.sum(up * up, axis=1) + 1e-12), 1.0)
    # (t, 3, s, b): points on each hair, halfway between two stamps
    points = node[:, 1, :, None] + share[None, None, :, None] * (up * part[:, None])[:, :, None]
    before = jnp.concatenate([points[:1], points[:-1]])
    rising = jnp.maximum(points[:, 2] - before[:, 2], 0.0)
    points = 0.5 * (points + before)
    moved = jnp.diff(node[:, 1], axis=0, prepend=node[:1, 1])
    way = jnp.sqrt(jnp.sum(moved * moved, axis=1) + 1e-12)
    # What of the hair's way counts in a cell that all of it lies in [mm]; none of hair that leaves
    # the paint.
    stays = jnp.clip(1.0 - p.cling * rising / way[:, None], 0.0, 1.0)
    each = hairs * weight[None, :, None] * way[:, None] * stays
    kept = jnp.exp(-jnp.mean(way, axis=1) / MEMORY)
    piece = piece[None, :, None]
    wake = hairs * WAKE * 2.0 * radius / pixel**2 * piece * way[:, None] * stays
    # Hair that rises leaves all of it behind.
    falls = 1.0 - jnp.exp(-way / BEHIND) * jnp.sum(piece * stays, axis=1)
    place = points[:, :2] / pixel - 0.5
    low = jnp.floor(place)
    place, high = place - low, jnp.maximum(points[:, 2] - relief, 0.0)
    first = low[:, ::-1].astype(jnp.int32) - corner[None, :, None, None]
    size = jnp.asarray([h, w], jnp.int32)[None, :, None, None]
    near = jnp.any(jnp.all((first >= -1) & (first < size), axis=1), axis=(1, 2))
    furthest = radius * (1.0 + p.coat_dry + FULL * p.coat_full) + jnp.max(film)
    near = near & track.valid & jnp.any(high < furthest, axis=(1, 2))
    refill = 1.0 - jnp.exp(-p.refill * way)

    def pass_over(carry, first, place, high, each, kept, wake, falls):
        film, hair, taken, tip, heap, last = carry
        full = jnp.minimum(tip / most, FULL)[None, None]
        coat = radius * (p.coat_dry + p.coat_full * full)
        reach, stands = radius + coat, STANDS * jnp.maximum(0.7 * coat - radius, 0.0)
        cells, shares, moving = [], [], []
        for dy in (0, 1):
            for dx in (0, 1):
                y, x = first[0] + dy, first[1] + dx
                inside = (y >= 0) & (y < h) & (x >= 0) & (x < w)
                cells.append(jnp.where(inside, y * w + x, h * w))
                along = place[0] if dx else 1.0 - place[0]
                across = place[1] if dy else 1.0 - place[1]
                shares.append(along * across)
                # Beyond the canvas, where a grid may end anywhere, nothing is taken along.
                y, x = y + corner[0], x + corner[1]
                moving.append(inside & (y >= 0) & (y < canvas[0]) & (x >= 0) & (x < canvas[1]))
        cell = jnp.stack(cells)
        under, gap_there = film[cell], gap[cell]
        share, on = jnp.stack(shares), jnp.stack(moving)
        moves = jnp.where(on, share, 0.0)
        # A point on a hair meets what is under it between the middles of columns, of the canvas
        # alone, so that all grids see the same.
        amount = jnp.sum(moves, axis=0, keepdims=True)
        amount = jnp.where(amount > 0.0, amount, 1.0)
        mean = lambda x: jnp.sum(moves * x, axis=0, keepdims=True) / amount  # noqa: E731
        here, low_here = mean(under), mean(gap_there)
        touch = jnp.clip((reach - (high[None] - here)) / reach, 0.0, 1.0)
        # A coat bridges gaps between threads only as far as it is thick.
        touch = touch * (1.0 - jnp.clip((low_here - here) / coat, 0.0, 1.0))
        above = high[None] + gap_there
        there = share * touch * each[None]
        even = jnp.maximum(high[None] + low_here + 0.7 * coat - radius, 0.0)
        sunk = jnp.clip((under - above) / (2.0 * radius) + 0.5, 0.0, 1.0)
        within = share * volume * sunk
        swept = moves * wake[None] * sunk
        # All along the hair, ahead of its tip, while any of it touches.
        lets = jnp.minimum(jnp.sum(moves * touch, axis=(0, 1)), 1.0)
        left = moves * piece * (lets * falls * taken)[None, None]
        sums = jnp.stack([there, there * even, within, swept], axis=-1)
        heap, sums = _meet(jax.lax.stop_gradient(heap), last, cell, sums)
        met, drawn, filled, wide = (sums[..., k] for k in range(4))
        some = jnp.where(met > 0.0, met, 1.0)
        wanted = drawn / some - under
        wanted = jnp.where(wanted < 0.0, LIFTED * wanted, wanted)
        # Not by expm1, which takes an eighth of the scan: what this rounds off is no paint.
        change = (1.0 - jnp.exp(-p.deposit * met)) * wanted
        some_wide = wide > 1e-3
        part = (1.0 - jnp.exp(-wide)) / jnp.where(some_wide, wide, 1.0)
        part = jnp.where(some_wide, part, 1.0 - 0.5 * wide)
        new = part * swept * jnp.maximum(under - above - stands, 0.0)
        comes = (1.0 - kept) * (filled - hair[cell]) / jnp.where(filled > 0.0, filled, 1.0)
        # A dry bristle gives less, and none more than half of what it holds.
        gives = there / some * change
        gives = jnp.where(gives > 0.0, gives * jnp.minimum(2.0 * full, 1.0), gives)
        given = jnp.sum(jnp.where(on, jnp.maximum(gives, 0.0), 0.0), axis=(0, 1))
        enough = given <= 0.5 * tip
        limit = jnp.where(enough, 1.0, 0.5 * tip / jnp.where(enough, 1.0, given))
        gives = jnp.where(gives > 0.0, gives * limit[None, None], gives)
        new_film, new_hair = gives + left - new, within * comes
        taken = taken + jnp.sum(new - left, axis=(0, 1))
        tip = tip - jnp.sum(jnp.where(on, gives, 0.0), axis=(0, 1))
        return new_film, new_hair, taken, tip, jax.lax.stop_gradient(heap), cell

    def step(carry, inputs):
        near, refill, *rest = inputs
        film, hair, taken, tip, behind, *others = carry
        # Added here and not in the branch: XLA's CPU back end would work out what is scattered one
        # number at a time.
        *new, taken, tip, heap, cell = jax.lax.cond(
            near,
            pass_over,
            lambda carry, *_: (none, none, *carry[2:]),
            (film, hair, taken, tip, *others),
            *rest,
        )
        film, hair = (x.at[cell].add(more) for x, more in zip((film, hair), new, strict=True))
        # As in the simulator (`paint.transfer.refill`).
        down = refill * jnp.maximum(most - tip, 0.0) * jnp.clip(behind / (0.3 * most_behind), 0, 1)
        down = jnp.minimum(down, 0.9 * behind) - 0.5 * jnp.maximum(tip - 1.8 * most, 0.0)
        return (film, hair, taken, tip + down, behind - down, heap, cell), None

    stamps = near, refill, first, place, high, each, kept, wake, falls
    heap = jnp.zeros((film.size, 4), film.dtype)
    last = jnp.full((4, *points.shape[2:]), h * w, jnp.int32)
    none = jnp.zeros(last.shape, film.dtype)
    start = film, hair, laid.taken, laid.tip, laid.behind, heap, last
    (film, hair, *each, _, _), _ = jax.lax.scan(step, start, stamps)
    return Laid(film[:-1].reshape(h, w), hair[:-1].reshape(h, w), *each)
