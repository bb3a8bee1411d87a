"""Exact trajectory maps: against loops, whatever the order of work, and where naive ways fail."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from raster_cases import (
    BRISTLES,
    PIXEL,
    SIDE,
    WIDTH,
    assert_finite,
    assert_same,
    canvas,
    colors,
    draw,
    exact_maps,
    leaves,
    make_track,
    moved,
    padded,
    random_track,
    reference,
    stack,
)

from jaxbrush.raster import FORCE_UNIT, exact, trajectory_maps
from jaxbrush.raster.sweeps import stroke_time, sweeps_of

RADIUS = 0.5 * WIDTH / PIXEL


def on_lattice(track):
    """The track with every position on a 64th of a pixel, so that shifts are exact."""
    fine = PIXEL / 64.0
    return dataclasses.replace(track, position=jnp.round(track.position / fine) * fine)


def line(stamps, start=(1.0, 3.0), end=(5.0, 3.0)):
    share = np.linspace(0.0, 1.0, stamps)[:, None]
    # Off the middle between pixels: their centres would lie on the very rim.
    return np.asarray(start) + share * (np.asarray(end) - np.asarray(start)) + 0.03


def loop(stamps):
    """Along x at y = 2.5, round through y > 2.5 and back across it at x = 3, near the end."""
    corner = np.array([[1.0, 2.5], [5.0, 2.5], [5.0, 5.0], [3.0, 5.0], [3.0, 0.5]])
    way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(corner, axis=0)).sum(1))])
    at = np.linspace(0.0, way[-1], stamps)
    return np.stack([np.interp(at, way, corner[:, k]) for k in range(2)], axis=1) + 0.03


def overlap(a, b):
    a, b = np.asarray(a) > 0, np.asarray(b) > 0
    return (a & b).sum() / (a | b).sum()


@pytest.mark.parametrize("seed", range(6))
def test_equals_loops_over_pixels(seed):
    # Long steps of 20 pixels, drawn in several windows, come up in every one of these tracks.
    track = random_track(seed, stamps=30, air=(0.0, 0.4, 0.7)[seed % 3])
    color, maps = colors(BRISTLES), exact_maps(track)
    want = reference(canvas(), track, WIDTH)
    sure = ~want.unsure
    covered = want.bristle >= 0
    assert sure.mean() > 0.97 and 0.1 < covered.mean() < 0.95 and want.passes.max() > 1
    np.testing.assert_array_equal(np.asarray(maps.coverage)[sure], covered[sure])
    np.testing.assert_array_equal(np.asarray(maps.sweeps)[sure], want.passes[sure])
    chosen = np.where(covered[..., None], color[want.bristle], 0.0).astype(np.float32)
    np.testing.assert_array_equal(np.asarray(maps.color)[sure], chosen[sure])

    # A sweep as short as a 10th of a pixel counts as partly a point, and near its sides the way to
    # its end is cut off: in pixels of that way, by less than 0.08 and by 0.32 radii.
    way = 0.08 + np.where(want.rim, 0.32 * RADIUS, 0.0)
    force = FORCE_UNIT * np.asarray(maps.pressure)
    assert np.all(np.abs(force - want.force)[sure] <= (1e-3 + way * want.fall)[sure])
    start, end = float(track.time[0]), float(track.time[-1])
    when = np.where(covered, (want.when - start) / (end - start), 0.0)
    error = np.abs(np.asarray(maps.time) - when)
    assert np.all(error[sure] <= (1e-5 + way * want.pace / (end - start))[sure])


def test_windows_that_are_not_square():
    # Wide bristles have windows of fewer rows than columns, and long steps both ways.
    assert exact.window_sides(3.0) == (11, 16) and exact.window_sides(2.0) == (8, 8)
    track, color, width = random_track(1, stamps=30), colors(BRISTLES), 6.0 * PIXEL
    maps = draw(canvas(), padded(track), color, width=width)
    want = reference(canvas(), track, width)
    sure, covered = ~want.unsure, want.bristle >= 0
    assert sure.mean() > 0.95 and covered.mean() > 0.3
    np.testing.assert_array_equal(np.asarray(maps.coverage)[sure], covered[sure])
    np.testing.assert_array_equal(np.asarray(maps.sweeps)[sure], want.passes[sure])
    chosen = np.where(covered[..., None], color[want.bristle], 0.0).astype(np.float32)
    np.testing.assert_array_equal(np.asarray(maps.color)[sure], chosen[sure])


def test_scatter_and_loop_agree():
    grid = canvas()

    @jax.jit
    def by_scatter(track):
        sweeps = sweeps_of(grid, track, 1, 0.0)
        table, stamps = exact.table_of(sweeps, RADIUS), track.time.shape[0]
        key, passes = exact.images(table, stamps, grid.shape, RADIUS, "gpu")
        return *exact.values(sweeps, table, key, RADIUS), passes, key

    track = padded(random_track(1))
    force, time, passes, key = by_scatter(track)
    maps = draw(grid, track, colors(BRISTLES), width=WIDTH)
    np.testing.assert_array_equal(force / FORCE_UNIT, maps.pressure)
    np.testing.assert_array_equal(time, maps.time)
    np.testing.assert_array_equal(passes, maps.sweeps)
    covered = np.asarray(key) > 0
    np.testing.assert_array_equal(covered, np.asarray(maps.coverage) > 0)
    own = colors(BRISTLES)[(np.asarray(key) - 1) % BRISTLES].astype(np.float32)
    np.testing.assert_array_equal(own[covered], np.asarray(maps.color)[covered])


def test_points_at_the_stamps_leave_gaps():
    path = line(5)  # 8 pixels from stamp to stamp, 3 wide
    covered = np.asarray(exact_maps(make_track(path)).coverage)
    ys, xs = (np.mgrid[:SIDE, :SIDE] + 0.5) * PIXEL
    points = np.zeros((SIDE, SIDE), bool)
    for x, y in path:
        points |= np.hypot(xs - x, ys - y) <= 0.5 * WIDTH
    row = slice(8, 40)
    assert np.all(covered[23, row] == 1.0) and np.all(covered[24, row] == 1.0)
    print(f"points at the stamps miss {np.mean(~points[23, row]):.0%} of the line")
    assert np.mean(~points[23, row]) > 0.5


def test_one_pass_counts_once_and_a_crossing_twice():
    for stamps in (3, 20, 200):
        sweeps = np.asarray(exact_maps(make_track(line(stamps))).sweeps)
        assert set(np.unique(sweeps)) == {0.0, 1.0} and (sweeps > 0).sum() > 90
    still = np.concatenate([line(10), np.repeat(line(10)[-1:], 30, axis=0)])
    sweeps = np.asarray(exact_maps(make_track(still)).sweeps)
    assert set(np.unique(sweeps)) == {0.0, 1.0}

    for stamps in (44, 220):
        maps = exact_maps(make_track(loop(stamps), np.linspace(50.0, 150.0, stamps)[:, None]))
        sweeps, time = np.asarray(maps.sweeps), np.asarray(maps.time)
        assert sweeps.max() == 2.0
        ys, xs = np.nonzero(sweeps == 2.0)
        # The square where the two arms lie over each other, and nothing else.
        assert 4 <= len(ys) <= 16
        assert np.abs(xs - 23.5).max() <= 2 and np.abs(ys - 19.5).max() <= 2
        assert time[19, 23] > 0.7, "the first arm lies on top"
        assert np.asarray(maps.pressure)[19, 23] > 120.0 / FORCE_UNIT


def test_shifts_and_clipping_are_exact():
    # A window anywhere shows what a larger canvas would: the same numbers, cut at its border.
    track = on_lattice(random_track(2, stamps=40))
    want = exact_maps(track)
    assert np.asarray(want.coverage).mean() > 0.1
    by = (5 * PIXEL, -7 * PIXEL)
    assert_same(exact_maps(moved(track, by), grid=canvas(by)), want)
    for dy, dx in ((11, -17), (-30, 40), (1, 1)):
        got = exact_maps(track, grid=canvas((dx * PIXEL, dy * PIXEL)))
        rows = slice(max(dy, 0), SIDE + min(dy, 0))
        cols = slice(max(dx, 0), SIDE + min(dx, 0))
        back = slice(max(-dy, 0), SIDE - max(dy, 0)), slice(max(-dx, 0), SIDE - max(dx, 0))
        for (name, a), (_, b) in zip(leaves(got)[:-1], leaves(want)[:-1], strict=True):
            np.testing.assert_array_equal(a[back], b[rows, cols], err_msg=name)
    away = exact_maps(track, grid=canvas((2 * SIDE * PIXEL, 0.0)))
    assert all(not np.any(x) for _, x in leaves(away)[:-1])


def test_a_window_of_one_pixel():
    track = on_lattice(random_track(2, stamps=40))
    want = exact_maps(track)
    y, x = np.argwhere(np.asarray(want.sweeps) > 1)[0]
    one = lambda y, x: draw(  # noqa: E731
        canvas((x * PIXEL, y * PIXEL), 1), padded(track), colors(BRISTLES), width=WIDTH
    )
    for row, col in ((y, x), (y + 1, x), (0, 0)):
        for (name, a), (_, b) in zip(leaves(one(row, col))[:-1], leaves(want)[:-1], strict=True):
            np.testing.assert_array_equal(a[0, 0], b[row, col], err_msg=name)


def test_turning_the_stroke_turns_the_maps():
    track = on_lattice(random_track(4, stamps=40))
    want = exact_maps(track)
    place = np.array(track.position)
    place[:, :, 0], place[:, :, 1] = place[:, :, 1].copy(), SIDE * PIXEL - place[:, :, 0]
    got = exact_maps(dataclasses.replace(track, position=jnp.asarray(place)))
    back = jax.tree.map(lambda x: np.rot90(x, -1) if x.ndim > 1 else x, got)
    assert overlap(back.coverage, want.coverage) > 0.995
    for (name, a), (_, b) in zip(leaves(back)[:-1], leaves(want)[:-1], strict=True):
        same = np.isclose(a, b, atol=1e-5).mean()
        assert same > 0.995, (name, same)


def test_finer_stamps_draw_the_same_maps():
    def arc(stamps):
        s = np.linspace(0.0, 1.0, stamps)
        path = np.stack([3.0 + 2.0 * np.cos(4.0 * s), 3.0 + 2.0 * np.sin(4.0 * s)], axis=1)
        return make_track(path, (60.0 + 80.0 * s)[:, None], time=0.3 * s)

    coarse, fine = exact_maps(arc(24)), exact_maps(arc(231))
    assert overlap(coarse.coverage, fine.coverage) > 0.98
    both = (np.asarray(coarse.coverage) > 0) & (np.asarray(fine.coverage) > 0)
    error = np.abs(np.asarray(coarse.time) - np.asarray(fine.time))[both]
    print(f"10x finer: IoU {overlap(coarse.coverage, fine.coverage):.4f}, time {error.max():.4f}")
    assert error.max() < 1.0 / 23
    error = np.abs(np.asarray(coarse.pressure) - np.asarray(fine.pressure))[both]
    assert error.max() * FORCE_UNIT < 80.0 / 23


def test_nothing_touches_nothing():
    path = random_track(0).position[:, 0, :2]
    empty = exact_maps(make_track(path, 0.0, height=1.0))
    assert all(not np.any(x) for _, x in leaves(empty)[:-1])
    # One bristle in the air above the others leaves the maps as they are.
    track = make_track(path[..., :2])
    more = make_track(path[..., :3], [100.0, 100.0, 0.0], height=[[0.0, 0.0, 0.3]])
    assert_same(exact_maps(more), exact_maps(track))
    invalid = exact_maps(make_track(path, valid=np.zeros(len(path))))
    assert all(not np.any(x) for _, x in leaves(invalid)[:-1])


def test_one_stamp_of_two_nodes():
    # Not padded: neither the stamps that tests share nor their bristles change a dab.
    place = np.array([[[2.0, 4.0, 4.5], [2.0, 3.0, 3.0]]])
    dab = make_track(place, [[50.0, 60.0, 70.0]], nodes=2)
    load = np.array(dab.force)
    load[0, 0] = [80.0, 0.0, 90.0]  # the node above the tip, 0.7 mm further in y
    dab = dataclasses.replace(dab, force=jnp.asarray(load))
    color = colors(3)
    maps = draw(canvas(), dab, color, width=WIDTH, nodes=2)
    six = np.concatenate([place + [[0.0], [0.7]], place], axis=2)
    height = np.array([[0.5, 0.5, 0.5, 0.0, 0.0, 0.0]])
    same = make_track(six, load.reshape(1, 6), height)
    assert_same(maps, exact_maps(same, np.concatenate([color, color])))
    middle = lambda x, y: np.asarray(maps.pressure)[int(y / PIXEL), int(x / PIXEL)]  # noqa: E731
    assert middle(2.0, 2.0) == pytest.approx(50.0 / FORCE_UNIT)
    assert middle(2.0, 2.7) == pytest.approx(80.0 / FORCE_UNIT)
    assert middle(4.0, 3.7) == 0.0
    area = np.pi * (0.5 * WIDTH) ** 2 / PIXEL**2
    dots = np.asarray(maps.coverage)[:, : int(3.0 / PIXEL)].sum()
    assert dots == pytest.approx(2 * area, rel=0.35)
    assert not np.any(maps.time) and np.asarray(maps.sweeps).max() == 1.0


def test_what_is_not_finite_stays_with_its_bristle():
    track = random_track(5)
    want = exact_maps(track)
    for bad in (np.nan, np.inf, -1e30):
        place = np.array(padded(track).position[:30])[..., :BRISTLES]
        place[:, :, :, 2] = bad
        broken = dataclasses.replace(padded(track, 30), position=jnp.asarray(place))
        left = np.array(track.force)
        left[:, :, 2] = 0.0
        rest = exact_maps(dataclasses.replace(track, force=jnp.asarray(left)))
        assert_same(exact_maps(broken), rest)
    assert np.any(np.asarray(rest.coverage) != np.asarray(want.coverage))


def test_time_and_force_have_their_units():
    track = make_track(line(25), np.linspace(40.0, 160.0, 25)[:, None], time=5.0 + np.arange(25.0))
    share = np.asarray(stroke_time(padded(track)))
    np.testing.assert_allclose(share[:25], np.linspace(0.0, 1.0, 25), atol=1e-6)
    maps = exact_maps(track)
    time, pressure = np.asarray(maps.time)[23, 8:40], np.asarray(maps.pressure)[23, 8:40]
    # A pixel is left when the middle of the bristle is nearly a radius beyond it.
    reach = np.sqrt(RADIUS**2 - 0.74**2)
    want = np.minimum((np.arange(32) + 0.26 + reach) / 32.0, 1.0)
    np.testing.assert_allclose(time, want, atol=1e-3)
    np.testing.assert_allclose(pressure * FORCE_UNIT, 40.0 + 120.0 * want, rtol=1e-2)
    assert float(np.max(maps.time)) == 1.0 and float(np.min(maps.time)) == 0.0
    still = exact_maps(make_track(line(5), time=np.full(5, 2.0)))
    assert_finite(still)
    assert not np.any(still.time) and np.any(still.coverage)


def test_values_follow_force_and_time(x64):
    track, grid = random_track(6, stamps=16), canvas()
    rng = np.random.default_rng(0)
    weight = jnp.asarray(rng.normal(size=(2, SIDE, SIDE)))
    lifted = track.force <= 0.0

    @jax.jit
    def slope(force, time):
        def total(force, time):
            # In the air a force has to stay 0: it decides about touch, not only about values.
            here = dataclasses.replace(track, force=jnp.where(lifted, 0.0, force), time=time)
            maps = trajectory_maps(grid, here, width=WIDTH)
            return jnp.sum(weight[0] * maps.pressure) + jnp.sum(weight[1] * maps.time)

        return jax.value_and_grad(total, (0, 1))(force, time)

    _, (by_force, by_time) = slope(track.force, track.time)
    assert_finite((by_force, by_time))
    h, way = 1e-6, rng.normal(size=track.time.shape)
    difference = [float(slope(track.force, track.time + s * h * way)[0]) for s in (1, -1)]
    difference = (difference[0] - difference[1]) / (2 * h)
    assert difference == pytest.approx(float(by_time @ way), rel=1e-4)
    # Where a tip lands depends on its depth, so only forces between pressed stamps keep coverage.
    inner = np.asarray(track.force) > 0
    inner[1:] &= np.asarray(track.force)[:-1] > 0
    inner[:-1] &= np.asarray(track.force)[1:] > 0
    way = jnp.asarray(rng.normal(size=inner.shape) * inner)
    h = 1e-4
    difference = [float(slope(track.force + s * h * way, track.time)[0]) for s in (1, -1)]
    difference = (difference[0] - difference[1]) / (2 * h)
    assert abs(difference) > 1e-4 and inner.sum() > 10
    assert difference == pytest.approx(float(jnp.sum(by_force * way)), rel=1e-5)


@pytest.mark.slow
def test_vmap_is_a_loop():
    tracks = [random_track(seed, stamps=12) for seed in (0, 1, 2)]
    grid, color = canvas(), colors(BRISTLES)
    batch = jax.jit(jax.vmap(lambda t: trajectory_maps(grid, t, color, width=WIDTH)))(stack(tracks))
    for k, track in enumerate(tracks):
        assert_same(jax.tree.map(lambda x, k=k: x[k], batch), exact_maps(track, color))


@pytest.mark.slow
def test_jit_is_op_by_op():
    track, grid = make_track(line(20)[:4]), canvas((0.5, 2.5), 12)
    with jax.disable_jit():
        plain = trajectory_maps(grid, track, width=WIDTH)
    got = jax.jit(trajectory_maps, static_argnames="width")(grid, track, width=WIDTH)
    assert np.any(got.coverage)
    for (name, a), (_, b) in zip(leaves(got), leaves(plain), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6, err_msg=name)


def test_other_strokes_do_not_compile():
    exact_maps(random_track(0))
    compiled = draw._cache_size()
    for seed in (1, 2):
        exact_maps(random_track(seed, stamps=20 + seed), colors(6, seed), canvas((seed, -seed)))
    assert draw._cache_size() == compiled


@pytest.mark.parametrize("edge", [None, 0.1])
def test_dtype_is_the_track_s(edge):
    def dtypes(grid, track):
        maps = jax.eval_shape(lambda g, t: trajectory_maps(g, t, edge=edge), grid, track)
        return {x.dtype.name for name, x in vars(maps).items() if name != "whole"}

    single, grid = random_track(0), canvas()
    assert dtypes(grid, single) == {"float32"}
    with jax.enable_x64(True):
        assert dtypes(canvas(), random_track(0)) == {"float64"}
        # A brush in single precision, in a session that defaults to double, and back.
        assert dtypes(canvas(), single) == {"float32"}
        assert dtypes(grid, random_track(0)) == {"float64"}


@pytest.mark.parametrize("edge", [None, 0.25])
def test_what_bristles_carry_may_change_on_the_way(edge):
    """At each stamp its own: the map tells of the stamp at which the latest bristle came."""
    track = padded(random_track(4, stamps=20, leap=0.0))
    stamps, bristles = track.position.shape[0], track.position.shape[-1]
    still = colors(bristles)
    every = np.broadcast_to(still, (stamps, bristles, 3))
    plain, same = (draw(canvas(), track, c, width=WIDTH, edge=edge) for c in (still, every))
    np.testing.assert_array_equal(plain.color, same.color)
    time = np.asarray(track.time)
    share = np.clip((time - time[0]) / (time[19] - time[0]), 0.0, 1.0)
    maps = draw(canvas(), track, share[:, None, None] * np.ones((1, bristles, 2)), width=WIDTH,
                edge=edge)  # fmt: skip
    assert maps.color.shape == (SIDE, SIDE, 2)
    np.testing.assert_array_equal(maps.color[..., 0], maps.color[..., 1])
    # When its stamp was, no earlier than it left the pixel and by a stamp at most.
    late = np.asarray(maps.color[..., 0] - maps.time)
    assert late.min() > -1e-4 and late.max() < np.diff(share).max() + 1e-4
    assert np.ptp(np.asarray(maps.time)) > 0.5 and late.max() > 1e-3


@pytest.mark.parametrize(
    "values, words",
    [
        ({"width": 0.0}, "width = 0.0"),
        ({"width": np.nan}, "width = nan"),
        ({"edge": 0.0}, "edge = 0.0"),
        ({"edge": -0.1}, "edge = -0.1"),
        ({"edge": 100.0}, "edge = 100.0"),
        ({"edge": 0.1, "longest": 0.0}, "longest = 0.0"),
        ({"nodes": 0}, "nodes = 0"),
        ({"nodes": 2}, "nodes = 2"),
        ({"nodes": -1}, "nodes = -1"),
        ({"color": 1.0}, r"color has shape \(\)"),
        ({"color": np.ones((3, 6, 3))}, r"color has shape \(3, 6, 3\)"),
        ({"color": np.ones((5, 3))}, r"color has shape \(5, 3\)"),
    ],
)
def test_errors_name_the_argument(values, words):
    with pytest.raises(ValueError, match=words):
        jax.eval_shape(lambda t: trajectory_maps(canvas(), t, **values), random_track(0))


@pytest.mark.parametrize("edge", [None, 0.1])
def test_a_track_without_stamps(edge):
    track = jax.tree.map(lambda x: x[:0], random_track(0))
    with pytest.raises(ValueError, match="a track of 0 stamps"):
        trajectory_maps(canvas(), track, edge=edge)
