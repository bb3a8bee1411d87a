"""The film that a stroke would leave if hair alone moved paint, and its hair, against closed
forms."""

import dataclasses
import functools
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbrush.brush import BristleTrack
from jaxbrush.film import ENDS, MEMORY, STANDS, WAKE, _meet, dipped, laid_film, lay_on
from jaxbrush.paint import weave
from jaxbrush.paint.state import make_params
from jaxbrush.raster import make_grid

PIXEL, LOAD = 0.125, 0.8
P = make_params()
COAT = float(P.hair_radius * (P.coat_dry + P.coat_full * LOAD))
EVEN = 0.7 * COAT - float(P.hair_radius)
"""Film under hair that lies on the canvas [mm]."""


def pulled(y, high=0.0, step=0.1, length=6.0, start=1.0):
    """Hair that lies along x and is pulled along it, stamps `step` apart [mm]."""
    way = np.arange(0.0, length + 1e-9, step)
    y = np.asarray(y, float)
    tip = np.empty((len(way), 3, len(y)))
    tip[:, 0] = start + way[:, None]
    tip[:, 1], tip[:, 2] = y[None], high
    position = np.stack([tip + np.array([[1.0], [0.0], [0.0]]), tip], axis=1)
    return BristleTrack(
        time=jnp.asarray(way, jnp.float32), position=jnp.asarray(position, jnp.float32),
        force=jnp.zeros((len(way), 2, len(y))), reaction=jnp.zeros((len(way), 3)),
        valid=jnp.ones(len(way), bool),
    )  # fmt: skip


def endless(**changes):
    """Constants of a brush that is as full at the end as it was."""
    return make_params(tip_volume=7.5e4, refill=0.0, **changes)


def not_refilled():
    return make_params(refill=0.0)


@functools.partial(jax.jit, static_argnames=("shape", "wake", "params"))
def both(
    track, height, hairs=1.0, load=LOAD, shape=(32, 80), origin=(0.0, 0.0), wake=WAKE,
    relief=0.0, params=endless,
):  # fmt: skip
    """On a smooth canvas, if not said otherwise, by a brush that does not run dry."""
    grid = make_grid(shape, origin, PIXEL)
    with mock.patch.multiple("jaxbrush.film", WAKE=wake, make_params=params):
        return laid_film(grid, track, hairs, load, height, relief)


def film(*args, **named):
    return both(*args, **named)[0]


def hair(*args, **named):
    return both(*args, **named)[1]


BARE = jnp.zeros((32, 80))
STILL = {"wake": 0.0}
"""Hair that lays and lifts, and takes nothing along."""


def test_many_hairs_leave_their_equilibrium_and_thicker_paint_is_drawn_down_to_it():
    track = pulled(np.full(60, 2.0 + 0.5 * PIXEL))  # over the middle of row 16
    # A stamp takes half of what is too much, however many hairs there are.
    close = pulled(np.full(60, 2.0 + 0.5 * PIXEL), step=0.05)
    for before in (0.0, 0.5 * EVEN, EVEN + 0.05):
        after = np.asarray(film(close, BARE + before, **STILL))[16, 24:48]
        np.testing.assert_allclose(after, EVEN, rtol=1e-3)
        # What is taken along falls behind as the stamps come, so that the film trembles.
        after = np.asarray(film(track, BARE + before))[16, 24:48]
        assert STANDS * EVEN < after.mean() < EVEN and after.max() < 1.6 * EVEN
        np.testing.assert_array_equal(film(track, BARE + before)[20], (BARE + before)[20])


def test_one_pass_of_one_hair_follows_the_rate():
    # At rest over a pixel but for one step: all of the film's change is one exponential.
    y, x = 16, 40
    track = pulled([(y + 0.5) * PIXEL], length=0.02, step=0.02, start=(x + 0.5) * PIXEL - 0.46)
    grown = np.asarray(film(track, BARE))
    share = float(P.contact_area) / 260 / PIXEL**2
    # The hair's length lies over 0.9 mm of the row, its mean weight 0.65.
    ways = -np.log1p(-grown[y] / EVEN) / float(P.deposit)
    assert ways.sum() == pytest.approx(0.65 * share * 0.02, rel=0.03)
    assert np.abs(np.delete(grown, y, 0)).max() == 0.0


def test_hair_in_the_air_and_none_leaves_the_canvas_bit_identical():
    height = jax.random.uniform(jax.random.key(0), (32, 80), maxval=0.1)
    for track in (
        pulled([2.0], high=1.0),
        dataclasses.replace(pulled([2.0]), valid=jnp.zeros(61, bool)),
    ):
        np.testing.assert_array_equal(film(track, height), height)


def test_hair_that_rides_higher_leaves_more():
    low, high = (film(pulled(np.full(60, 2.06), high=z), BARE)[16, 40] for z in (0.0, 0.08))
    assert float(high) > 1.2 * float(low)


def test_hair_that_leaves_the_paint_gives_nothing():
    """Lifted by half a millimetre where it stands, it would draw the film up with it."""
    track = pulled(np.full(60, 2.06), length=3.0)
    lifted = jnp.repeat(track.position[-1:], 10, axis=0)
    lifted = lifted.at[:, :, 2].add(jnp.linspace(0.05, 0.5, 10)[:, None, None])
    position = jnp.concatenate([track.position, lifted])
    more = dataclasses.replace(
        track, time=jnp.arange(41.0), position=position, valid=jnp.ones(41, bool)
    )
    held = dataclasses.replace(more, valid=jnp.arange(41) < 31)
    np.testing.assert_allclose(film(more, BARE, **STILL), film(held, BARE, **STILL), atol=1e-6)
    # Pulled on while it rises slowly, it gives what it can.
    slow = pulled(np.full(60, 2.06))
    rise = jnp.linspace(0.0, 0.2, 61)[:, None, None]
    risen = dataclasses.replace(slow, position=slow.position.at[:, :, 2].add(rise))
    assert float(film(risen, BARE)[16, 48]) > 1.2 * float(film(slow, BARE)[16, 48])


def test_grooves_follow_single_hairs():
    # Two rows of hair, six pixels apart.
    for named, least in ((STILL, 0.9), ({}, STANDS)):
        after = np.asarray(film(pulled([1.56] * 9 + [2.31] * 9), BARE, **named))[:, 40]
        assert min(after[12], after[18]) > least * EVEN and after[15] == 0.0


def test_a_brush_runs_dry_and_no_paint_is_made_or_lost():
    """Through wet paint, which it takes up too, and on over bare canvas. Naively, at the load it
    was dipped with, it lays as much at the end as before."""
    track = pulled(np.random.default_rng(0).uniform(1.2, 2.8, 40), start=0.5, length=7.5)
    height = BARE.at[8:24, 16:28].set(0.3)
    grid = make_grid((32, 80), (0.0, 0.0), PIXEL)
    begun = dipped(PIXEL, height, 40, 1.0, 0.03)
    laid = jax.jit(lay_on, static_argnums=3)(grid, track, 1.0, (32, 80), begun, 0.0)
    total = lambda x: sum(float(a.sum()) for a in (x.film, x.taken, x.tip, x.behind))  # noqa: E731
    assert total(laid) == pytest.approx(total(begun), rel=1e-6)
    assert float(laid.tip.min()) >= 0.0 and float(laid.behind.min()) >= 0.0
    assert float(laid.tip.max()) <= 1.8 * float(begun.tip[0]) / 0.03
    thick = lambda film, a, b: float(film[10:22, int(a / PIXEL) : int(b / PIXEL)].mean())  # noqa: E731
    dry, full = (film(track, BARE, params=params, **STILL) for params in (not_refilled, endless))
    assert thick(full, 7.0, 8.0) > 0.95 * thick(full, 2.0, 3.0)
    assert thick(dry, 7.0, 8.0) < 0.6 * thick(dry, 2.0, 3.0)


def test_a_dry_brush_paints_the_threads_of_a_coarse_weave_and_a_full_one_fills_it():
    track = pulled(np.random.default_rng(0).uniform(1.2, 2.8, 60))
    cloth = np.asarray(weave((32, 80), PIXEL, 0.09))[11:21, 24:48]

    def films(load, relief):
        found = np.asarray(film(track, BARE, load=load, relief=relief, **STILL))[11:21, 24:48]
        return found[cloth > 0.07].mean(), found[cloth < 0.02].mean()

    threads, between = films(0.08, 0.09)
    naive = films(0.25, 0.0)
    full = films(0.8, 0.09)
    print("film on threads and between [mm]:", threads, between, naive, full)
    assert threads > 3.0 * between and naive[0] < 1.3 * naive[1]
    assert full[1] > full[0]


def test_a_dry_hair_leaves_its_line_between_columns_over_threads_and_gaps():
    """What hair reaches is asked where it is, between the middles of columns, as in the simulator.
    Naively, each column for itself, those that are deeper than its coat is thick get none: dry
    strokes were the lattice of the threads, without streaks."""
    load, relief, count = 0.16, 0.09, 0
    coat = float(P.hair_radius * (P.coat_dry + P.coat_full * load))
    gap = relief - np.asarray(weave((32, 80), PIXEL, relief))
    for row in range(12, 20):
        track = pulled([row * PIXEL] * 9)  # on the edge between two rows
        found = np.asarray(film(track, BARE, load=load, relief=relief, **STILL))
        laid, deep = found[row - 1 : row + 1, 24:48], gap[row - 1 : row + 1, 24:48]
        beside = (deep.max(0) > coat) & (deep.min(0) < 0.5 * coat) & (deep.mean(0) < 0.9 * coat)
        assert np.all(laid[:, beside].min(0) > 0.8 * laid[:, beside].max(0))
        assert np.all(laid[:, beside] > 0.01)
        count += beside.sum()
    assert count > 20


def test_hair_in_the_film_has_the_volume_that_is_there():
    # Hair that stays long enough in deep paint: its volume but for the taper, 0.75 on average.
    track = pulled([1.5, 2.5], length=0.0, start=3.0)
    track = jax.tree.map(lambda x: jnp.repeat(x, 500, axis=0), track)
    deep = jnp.full((32, 80), 0.4)
    # Way is what counts, so hair that only rests leaves no trace.
    assert float(hair(jax.tree.map(lambda x: x[:200], track), deep).max()) < 1e-5
    sway = 0.02 * jnp.sin(jnp.arange(500.0))[:, None, None]
    track = dataclasses.replace(
        track, position=track.position.at[:, :, 0].add(sway), valid=jnp.ones(500, bool)
    )
    found = np.asarray(hair(track, deep, 2.0))
    one = np.pi * float(P.hair_radius) ** 2 * float(P.hair_length)
    assert found.sum() * PIXEL**2 == pytest.approx(2.0 * 2 * 0.75 * one, rel=0.05)
    # Half of hair at the film's surface is in it, and none of what is well above.
    level = lambda film: float(hair(track, jnp.full((32, 80), film), 2.0, 0.0).sum())  # noqa: E731
    assert level(0.0) == pytest.approx(0.5 * found.sum(), rel=0.15)
    high = dataclasses.replace(track, position=track.position.at[:, :, 2].add(1.0))
    assert float(hair(high, deep).max()) == 0.0


def test_the_last_hair_counts():
    """One hair that follows twelve over a pixel leaves of them exp(-way / MEMORY), of the way on
    which it is there: 0.7 mm between its points, and a pixel to a point's both sides."""
    deep, at = jnp.full((32, 80), 0.4), (16, 30)
    group, one = (pulled([2.06] * n, start=x) for n, x in ((12, 2.0), (1, 0.0)))
    position = jnp.concatenate([group.position, one.position], axis=-1)
    found = [
        float(hair(t, deep, **STILL)[at])
        for t in (dataclasses.replace(one, position=position), group, one)
    ]
    assert found[1] == pytest.approx(12.0 * found[2], rel=1e-3)
    left = (found[0] - found[2]) / found[1]
    assert np.exp(-0.93 / MEMORY) < left < np.exp(-0.7 / MEMORY)


def test_stamps_twice_as_close_change_little():
    height = 0.1 * jnp.ones((32, 80))
    y = np.random.default_rng(0).uniform(1.5, 2.5, 24)
    for wake, most in ((0.0, 0.03), (WAKE, 0.12)):
        coarse, fine = (both(pulled(y, step=s), height, wake=wake) for s in (0.1, 0.05))
        for a, b, before in zip(coarse, fine, (height, 0.0), strict=True):
            change = np.abs(np.asarray(b) - before).max()
            assert np.sqrt(np.mean((np.asarray(a) - np.asarray(b)) ** 2)) < most * change


def test_points_close_at_the_tip_find_where_standing_hair_touches():
    """Four pieces of one length have one point where hair that stands touches with its tip. Hair
    that lies flat would rather have those; networks would not (`film.ENDS`)."""
    y = np.random.default_rng(0).uniform(1.5, 2.5, 24)
    grid = make_grid((32, 80), (0.0, 0.0), PIXEL)

    def leaning(angle):
        track = pulled(y)
        root = jnp.asarray([np.cos(angle), 0.0, np.sin(angle)], jnp.float32)[None, :, None]
        position = track.position.at[:, 0].set(track.position[:, 1] + root)
        return dataclasses.replace(track, position=position)

    def laid(ends):
        with mock.patch.multiple("jaxbrush.film", ENDS=tuple(ends), make_params=endless):
            run = jax.jit(lambda track: laid_film(grid, track, 1.0, LOAD, BARE, 0.0)[0])
            return [np.asarray(run(leaning(angle))) for angle in (0.05, 0.7, 0.8, 0.9)]

    many = laid(np.linspace(0.0, 1.0, 33))
    ours, even = (
        [np.sqrt(np.mean((a - b) ** 2) / np.mean(b**2)) for a, b in zip(f, many, strict=True)]
        for f in (laid(ENDS), laid(np.linspace(0.0, 1.0, 5)))
    )
    print("flat, standing:", ours, even)
    assert np.mean(ours[1:]) < 0.12 and np.mean(even[1:]) > 0.25
    assert max(ours) < 0.15


def test_what_hair_takes_along_stays_where_it_lifts():
    """Through wet paint to x = 7, and up."""
    y = np.random.default_rng(1).uniform(1.6, 2.4, 60)
    track = pulled(y, length=6.0)
    risen = jnp.repeat(track.position[-1:], 5, axis=0)
    risen = risen.at[:, :, 2].add(jnp.linspace(0.1, 0.5, 5)[:, None, None])
    n = 66
    track = dataclasses.replace(
        track, time=jnp.arange(float(n)), valid=jnp.ones(n, bool),
        position=jnp.concatenate([track.position, risen]),
    )  # fmt: skip
    wet = BARE + 0.3
    grid = make_grid((32, 80), (0.0, 0.0), PIXEL)
    begun = dipped(PIXEL, wet, 60, 1.0, LOAD)
    track_of = lambda s: jax.tree.map(lambda x: x[s], track)  # noqa: E731
    until = lay_on(grid, track_of(slice(0, 61)), 1.0, (32, 80), begun, 0.0)
    laid = lay_on(grid, track_of(slice(60, n)), 1.0, (32, 80), until, 0.0)
    held = float(until.taken.sum())
    # What they hold while they go is what some millimetres of the way bring.
    brought = (0.3 - STANDS * EVEN) * 0.9 / PIXEL**2
    assert brought < held < 5.0 * brought
    assert float(laid.taken.sum()) < 0.02 * held
    # It stays under the hair, 0.9 mm ahead of its tip, and nowhere else.
    ridge = np.asarray(laid.film - until.film)
    there = ridge[:, int(6.9 / PIXEL) : int(8.1 / PIXEL)].sum()
    assert there == pytest.approx(held, rel=0.15) and there == pytest.approx(ridge.sum(), rel=0.02)
    assert float(laid.film.max()) > 1.3 * 0.3


def test_paint_that_is_taken_along_is_neither_made_nor_lost(monkeypatch):
    """Hair that lays and lifts nothing itself."""
    monkeypatch.setattr("jaxbrush.film.make_params", lambda: endless(deposit=0.0))
    track = pulled(np.random.default_rng(1).uniform(1.2, 2.8, 40), length=4.0)
    start = BARE + 0.3
    grid = make_grid((32, 80), (0.0, 0.0), PIXEL)
    laid = lay_on(grid, track, 1.0, (32, 80), dipped(PIXEL, start, 40, 1.0, LOAD))
    assert float(laid.taken.sum()) > 1.0
    total = float(laid.film.sum() + laid.taken.sum())
    assert total == pytest.approx(float(start.sum()), rel=1e-6)
    assert float(laid.film.min()) >= 0.0


def test_a_stroke_in_pieces_is_as_the_whole():
    height = jax.random.uniform(jax.random.key(0), (32, 80), maxval=0.2)
    track = pulled(np.random.default_rng(0).uniform(0.2, 3.8, 40), start=-2.0, length=14.0)
    whole = both(track, height, relief=0.09, params=make_params)
    grid = make_grid((32, 80), (0.0, 0.0), PIXEL)
    laid = dipped(PIXEL, height, 40, 1.0, LOAD)
    go = jax.jit(lay_on, static_argnums=3)
    for first in range(0, 140, 20):
        piece = jax.tree.map(lambda x, a=first: x[a : a + 21], track)
        piece = dataclasses.replace(piece, valid=piece.valid & (jnp.arange(21) >= int(first > 0)))
        laid = go(grid, piece, 1.0, (32, 80), laid, 0.09)
    np.testing.assert_allclose(laid.film, whole[0], atol=1e-6)
    np.testing.assert_allclose(laid.hair, whole[1], atol=1e-6)


def test_grids_that_hold_a_stroke_are_as_the_whole_canvas_to_the_bit():
    film = functools.partial(both, relief=0.09, params=make_params)
    height = jax.random.uniform(jax.random.key(0), (32, 80), maxval=0.2)
    track = pulled(np.random.default_rng(0).uniform(1.3, 2.7, 40), start=4.0, length=2.0)
    whole = np.asarray(film(track, height)[0])
    origin = jnp.asarray([24 * PIXEL, 8 * PIXEL])
    part = np.asarray(film(track, height, shape=(16, 40), origin=origin)[0])
    np.testing.assert_array_equal(part, whole[8:24, 24:64])
    # So are those of one that comes from beyond the canvas and goes there.
    track = pulled(np.random.default_rng(0).uniform(0.2, 3.8, 40), start=-2.0, length=14.0)
    whole = np.asarray(film(track, height)[0])
    # Off its edges the canvas goes on, as the networks see it.
    origin = jnp.asarray([-8 * PIXEL, -8 * PIXEL])
    around = np.asarray(film(track, height, shape=(48, 96), origin=origin)[0])
    np.testing.assert_array_equal(around[8:40, 8:88], whole)
    np.testing.assert_array_equal(around[:4, 8:88], np.broadcast_to(height[0], (4, 80)))


def test_slopes_are_those_of_differences_and_finite():
    height = 0.05 * jnp.ones((32, 80))
    track = pulled(np.random.default_rng(0).uniform(1.6, 2.4, 12), length=2.0)

    def total(shift, raised):
        position = track.position + jnp.stack([0.0 * shift, shift, raised])[None, None, :, None]
        track_there = dataclasses.replace(track, position=position)
        found = film(track_there, height, relief=0.05, params=make_params)
        return jnp.sum(found * jnp.linspace(0.0, 1.0, 32)[:, None])

    with jax.enable_x64(False):
        slopes = jax.grad(total, (0, 1))(0.013, 0.07)
        e = 2e-3
        by_shift = (total(0.013 + e, 0.07) - total(0.013 - e, 0.07)) / (2 * e)
        by_height = (total(0.013, 0.07 + e) - total(0.013, 0.07 - e)) / (2 * e)
    np.testing.assert_allclose(slopes, (by_shift, by_height), rtol=0.03)
    none = jax.grad(lambda h: film(pulled([2.0], high=0.0), h).sum())(BARE)
    assert np.all(np.isfinite(none))


def meet_naively(heap, last, cell, parts):
    return heap, jnp.zeros_like(heap).at[cell].add(parts)[cell]


def test_sums_over_cells_and_their_slopes_are_those_in_new_zeros():
    def sums(meet, heap, last, cell, parts, way):
        return jax.jvp(lambda x: meet(heap, last, cell, x)[1], [parts], [way])

    rng = np.random.default_rng(0)
    heap, last = jnp.zeros((50, 4)), jnp.full((4, 7), 49, jnp.int32)
    for _ in range(4):
        cell = jnp.asarray(rng.integers(0, 50, (4, 7)), jnp.int32)
        parts, way = (jnp.asarray(rng.normal(size=(4, 7, 4)), jnp.float32) for _ in range(2))
        want = sums(meet_naively, heap, last, cell, parts, way)
        np.testing.assert_array_equal(sums(_meet, heap, last, cell, parts, way), want)
        (heap, _), last = _meet(heap, last, cell, parts), cell


def eqns_of(jaxpr):
    for eqn in jaxpr.eqns:
        yield eqn
        for x in jax.tree.leaves(list(eqn.params.values())):
            if hasattr(x, "eqns") or hasattr(x, "jaxpr"):
                yield from eqns_of(getattr(x, "jaxpr", x))


def made_in(jaxpr):
    """Numbers in all arrays that a function makes anew, apart from updates in place."""
    in_place = ("scatter", "scatter-add", "stop_gradient")
    total = 0
    for eqn in jaxpr.eqns:
        inner = [x for x in jax.tree.leaves(list(eqn.params.values())) if hasattr(x, "eqns")]
        total += sum(made_in(getattr(x, "jaxpr", x)) for x in inner)
        if not inner and eqn.primitive.name not in in_place:
            total += sum(v.aval.size for v in eqn.outvars)
    return total


def test_a_stamp_takes_no_longer_on_a_larger_grid():
    track = pulled([1.0, 2.0])

    def made(side):
        grid = make_grid((side, side), (0.0, 0.0), PIXEL)
        lay = lambda height: laid_film(grid, track, 1.0, LOAD, height)  # noqa: E731
        found = jax.make_jaxpr(lay)(jnp.zeros((side, side)))
        scans = [e for e in eqns_of(found.jaxpr) if e.primitive.name == "scan"]
        return sum(made_in(e.params["jaxpr"].jaxpr) for e in scans)

    assert made(64) == made(256) < 2 * 64 * 64
    with mock.patch("jaxbrush.film._meet", meet_naively):
        assert made(256) > 10 * made(64) > 4 * 64 * 64  # the naive way


def test_tips_alone_are_refused():
    track = pulled([2.0])
    with pytest.raises(ValueError, match="1 node: expected at least 2"):
        film(dataclasses.replace(track, position=track.position[:, 1:]), BARE)


def test_in_a_batch_it_is_the_same():
    tracks = [pulled([2.0, 2.3]), pulled([1.7, 2.9], high=0.05)]
    many = jax.vmap(lambda t: film(t, BARE))(jax.tree.map(lambda *x: jnp.stack(x), *tracks))
    for found, track in zip(many, tracks, strict=True):
        np.testing.assert_allclose(found, film(track, BARE), atol=1e-6)
