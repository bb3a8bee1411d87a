"""Soft trajectory maps: they tend to the exact ones, and their slopes are true and finite."""

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
    canvas,
    colors,
    draw,
    leaves,
    make_track,
    moved,
    padded,
    random_track,
    reference,
    stack,
)

from jaxbrush.brush import BrushConfig, make_brush, rollout
from jaxbrush.raster import FORCE_UNIT, soft, trajectory_maps
from jaxbrush.stylus import make_stroke

EDGE = 0.125
STAMPS = 200
NAMES = ("pressure", "sweeps", "color", "time", "coverage")
WEIGHTS = {
    name: np.random.default_rng(k).normal(size=(SIDE, SIDE, 3) if name == "color" else (SIDE, SIDE))
    for k, name in enumerate(NAMES)
}


@jax.jit
def both(track, color):
    """((number, maps), slopes): one function that most tests share, in either precision."""

    def total(position, force, time, color):
        here = dataclasses.replace(track, position=position, force=force, time=time)
        maps = trajectory_maps(canvas(), here, color, width=WIDTH, edge=EDGE)
        weights = {name: jnp.asarray(w, position.dtype) for name, w in WEIGHTS.items()}
        return sum(jnp.sum(w * getattr(maps, name)) for name, w in weights.items()), maps

    with_maps = jax.value_and_grad(total, (0, 1, 2, 3), has_aux=True)
    return with_maps(track.position, track.force, track.time, color)


def run(track):
    return both(padded(track, STAMPS), jnp.asarray(colors(BRISTLES)))


def soft_maps(track):
    return run(track)[0][1]


def line(stamps, off=0.0):
    s = np.linspace(0.0, 1.0, stamps)
    return np.stack([1.03 + 4.0 * s, 3.03 + off + 0.4 * s], axis=1)


def covers(track):
    """How much each sweep alone covers each pixel, (t * b, h, w), by plain geometry."""
    ys, xs = (np.mgrid[:SIDE, :SIDE] + 0.5) * PIXEL
    path = np.asarray(track.position)[:, -1, :2]
    found = []
    for t in range(len(path)):
        for b in range(path.shape[2]):
            start, way = path[max(t - 1, 0), :, b], path[t, :, b] - path[max(t - 1, 0), :, b]
            square = max(way @ way, 1e-12)
            share = np.clip(((xs - start[0]) * way[0] + (ys - start[1]) * way[1]) / square, 0, 1)
            far = np.hypot(xs - start[0] - share * way[0], ys - start[1] - share * way[1])
            x = np.clip((0.5 * WIDTH - far) / EDGE + 0.5, 0.0, 1.0)
            found.append(x * x * (3.0 - 2.0 * x))
    return np.stack(found)


def error_of(maps, want, track):
    """Mean distance of each map to the exact maps, drawn by loops."""
    covered = want.bristle >= 0
    start, end = float(track.time[0]), float(track.time[-1])
    exact = {
        "pressure": want.force / FORCE_UNIT,
        "sweeps": want.passes,
        "color": np.where(covered[..., None], colors(BRISTLES)[want.bristle], 0.0),
        "time": np.where(covered, (want.when - start) / (end - start), 0.0),
        "coverage": covered,
    }
    return np.array([np.abs(np.asarray(getattr(maps, n)) - exact[n]).mean() for n in NAMES])


def test_tends_to_the_exact_maps(x64):
    track = random_track(1, step=0.25, leap=0.0)
    want = reference(canvas(), track, WIDTH, "trailing")
    wide = soft_maps(track)
    narrow = draw(canvas(), padded(track), colors(BRISTLES), width=WIDTH, edge=EDGE / 8)
    assert bool(wide.whole) and bool(narrow.whole)
    ratio = error_of(wide, want, track) / error_of(narrow, want, track)
    print(f"error of {NAMES} with {EDGE} mm over {EDGE / 8}: {ratio.round(1)}")
    # Of first order: 8. Few pixels lie in the narrow edge, so chance has its part.
    assert np.all(ratio > 5.0) and np.all(error_of(narrow, want, track) < 0.02)
    # Without the share of a wider edge there is no more than exact coverage.
    sure = ~want.unsure & ((want.bristle >= 0) == (np.asarray(narrow.coverage) > 0.5))
    assert sure.mean() > 0.97


def test_the_bristle_that_trails_comes_last(x64):
    # A row of bristles along its own way, each over where all the others go: in order of their
    # numbers, the last lies on top wherever it is in the row.
    root = 0.15 * np.array([2.0, 0.0, 5.0, 1.0, 4.0, 3.0])
    way = 1.0 + 0.4 * np.arange(6.0)
    path = np.stack([way[:, None] + root, 3.0 + 0.0 * (way[:, None] + root)], axis=1)
    for turn, last in ((1.0, 1), (-1.0, 2)):
        maps = soft_maps(make_track(path if turn > 0 else path[::-1]))
        middle = np.asarray(maps.color)[24, 13:25]
        np.testing.assert_allclose(middle, colors(BRISTLES)[None, last].repeat(12, 0), atol=1e-3)


def test_what_is_not_finite_draws_nothing(x64):
    track = random_track(2, stamps=60, step=0.25, leap=0.0)
    color = jnp.asarray(colors(BRISTLES))
    for name, bad in (("position", np.nan), ("position", np.inf), ("force", np.nan)):
        value = np.array(getattr(track, name))
        value[:, :, ..., 2] = bad
        (_, maps), slopes = run(dataclasses.replace(track, **{name: jnp.asarray(value)}))
        left = np.array(track.force)
        left[:, :, 2] = 0.0
        gone = np.array(track.position)
        gone[:, :, 2, 2] = 9.0
        rest = dataclasses.replace(track, force=jnp.asarray(left), position=jnp.asarray(gone))
        for (key, a), (_, b) in zip(leaves(maps), leaves(soft_maps(rest)), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-12, err_msg=key)
        assert_finite(slopes)
    # A step out of a stamp that is not finite draws nothing either.
    value = np.array(track.position)
    value[30, :, 0, 1] = np.nan
    (_, maps), slopes = both(
        padded(dataclasses.replace(track, position=jnp.asarray(value)), STAMPS), color
    )
    assert_finite((maps, slopes))
    assert bool(maps.whole)


def test_finer_stamps_do_not_fatten(x64):
    force = lambda n: np.linspace(60.0, 140.0, n)[:, None]  # noqa: E731
    coarse, fine = (make_track(line(n), force(n)) for n in (20, 191))
    a, b = soft_maps(coarse), soft_maps(fine)
    want = covers(coarse).max(axis=0)
    # Nearly full counts as full.
    np.testing.assert_allclose(a.coverage, want, atol=soft.SLACK)
    np.testing.assert_allclose(b.coverage, want, atol=soft.SLACK)
    np.testing.assert_allclose(a.sweeps, want, atol=1e-3)
    np.testing.assert_allclose(b.sweeps, want, atol=2e-3)
    np.testing.assert_allclose(a.time, b.time, atol=1.0 / 19)
    np.testing.assert_allclose(a.pressure, b.pressure, atol=80.0 / 19 / FORCE_UNIT)

    # Painting every capsule over those before it makes the rim full.
    over = [1.0 - np.prod(1.0 - covers(track), axis=0) for track in (coarse, fine)]
    grown = [cover.sum() / want.sum() - 1.0 for cover in over]
    print(f"every capsule over the others: area +{grown[0]:.0%}, sampled 10x finer +{grown[1]:.0%}")
    assert np.asarray(b.coverage).sum() == pytest.approx(want.sum(), rel=1e-3)
    assert grown[0] > 0.02 and grown[1] > 0.1


def test_a_later_touch_takes_nothing_away(x64):
    # Failure: a keep of (1 - a) / (1 - a_before + 0.01) wears off what other bristles left under
    # the rim of one that goes by or rests, the more the finer the stamps (15 % here).
    for stamps in (20, 95):
        first, second = line(stamps), line(stamps, 0.15)
        # The first stays in the air where it ends, the second starts from where it waits.
        first = np.concatenate([first, np.repeat(first[-1:], stamps, axis=0)])
        second = np.concatenate([np.repeat(second[:1], stamps, axis=0), second])
        path = np.stack([first, second], axis=2)
        force = np.full((2 * stamps, 2), 100.0)
        force[stamps:, 0], force[:stamps, 1] = 0.0, 0.0
        together = np.asarray(soft_maps(make_track(path, force, height=5.0)).coverage)
        alone = [make_track(line(stamps, off)) for off in (0.0, 0.15)]
        a, b = (np.asarray(soft_maps(track).coverage) for track in alone)
        np.testing.assert_allclose(together, 1.0 - (1.0 - a) * (1.0 - b), atol=5e-3)


def test_coverage_is_a_share_and_grows_with_force(x64):
    before = None
    # From 3 um above the canvas, where the edge begins to feel it, to pressed.
    for force, height in (
        (0.0, 0.09),
        (0.0, 0.03),
        (0.0, 0.01),
        (0.5, 0.0),
        (1.5, 0.0),
        (9.0, 0.0),
    ):
        maps = soft_maps(make_track(line(20), force, height))
        cover = np.asarray(maps.coverage)
        assert cover.min() >= 0.0 and cover.max() <= 1.0
        if before is None:
            assert not np.any(cover)
        else:
            assert np.all(cover >= before - 1e-12) and cover.sum() > before.sum() + 1.0
        before = cover
    assert before.max() == 1.0
    for seed in range(4):
        cover = np.asarray(soft_maps(random_track(seed, stamps=40, leap=0.0)).coverage)
        assert cover.min() >= 0.0 and cover.max() <= 1.0 + 1e-12 and 0.1 < (cover == 1.0).mean()


def test_premultiplied_values_stay_below_their_cover(x64):
    maps = soft_maps(make_track(line(60), np.linspace(50.0, 150.0, 60)[:, None]))
    cover = np.asarray(maps.coverage)
    for name, low, high in (("pressure", 0.25, 0.75), ("time", 0.0, 1.0)):
        value = np.asarray(getattr(maps, name))
        assert np.all(value >= low * cover - 1e-9) and np.all(value <= high * cover + 1e-9), name
    own = colors(BRISTLES)[0]
    np.testing.assert_allclose(maps.color, cover[..., None] * own, atol=1e-9)


def test_whole_says_when_steps_are_too_long(x64):
    # 0.5 mm are reached; the window's whole pixels may allow a little more.
    for step, whole in ((0.2, True), (0.5, True), (0.7, False), (3.0, False)):
        path = np.array([[1.0, 3.0], [1.1, 3.0], [1.1 + step, 3.0], [1.2 + step, 3.0]])
        assert bool(soft_maps(make_track(path)).whole) is whole, step
    # In the air, and in padding, steps may be of any length.
    force = np.array([100.0, 0.0, 0.0, 100.0])[:, None]
    path = np.array([[1.0, 3.0], [1.1, 3.0], [5.1, 3.0], [5.2, 3.0]])
    assert bool(soft_maps(make_track(path, force, height=1.0)).whole)


def test_slope_is_the_finite_difference(x64):
    # A tip at rest is where two sweeps meet in every pixel: a kink, so none rests here.
    track = padded(random_track(2, stamps=60, step=0.25, rest=0.0, leap=0.0), STAMPS)
    color, rng = jnp.asarray(colors(BRISTLES)), np.random.default_rng(0)
    (_, maps), slopes = both(track, color)
    assert bool(maps.whole)
    assert_finite(slopes)
    pressed, valid = np.asarray(track.contact), np.asarray(track.valid)
    ways = {
        "position": rng.normal(size=track.position.shape) * valid[:, None, None, None],
        # At a force of 0 the height takes over: the slope differs from side to side.
        "force": rng.normal(size=track.force.shape) * pressed,
        "time": rng.normal(size=track.time.shape) * valid,
        "color": rng.normal(size=color.shape),
    }  # fmt: skip
    for (name, way), slope, h in zip(ways.items(), slopes, (1e-7, 1e-4, 1e-7, 1e-4), strict=True):
        if name == "color":
            ends = [both(track, color + s * h * way)[0][0] for s in (1.0, -1.0)]
        else:
            value = getattr(track, name)
            ends = [
                both(dataclasses.replace(track, **{name: value + s * h * way}), color)[0][0]
                for s in (1.0, -1.0)
            ]
        difference = float(ends[0] - ends[1]) / (2 * h)
        found = float(jnp.sum(slope * way))
        print(f"{name}: slope {found:.6g}, central difference {difference:.6g}")
        assert abs(found) > 1e-3
        assert found == pytest.approx(difference, rel=1e-3), name


# In single precision only when asked: the slope takes XLA 14 s to compile once more.
@pytest.mark.parametrize("double", [pytest.param(False, marks=pytest.mark.slow), True])
def test_singular_strokes_have_finite_slopes(double):
    with jax.enable_x64(double):
        s = np.linspace(0.0, 1.0, 20)
        spot = np.broadcast_to(np.array([[3.0625], [3.0625]])[None], (20, 2, 1))  # a pixel's centre
        same = np.repeat(line(20)[..., None], BRISTLES, axis=2)
        back = np.stack([3.0 + np.abs(s - 0.5), np.full(20, 3.0)], axis=1)
        cases = {
            "coincident points": make_track(np.repeat(line(10), 2, axis=0)),
            "at rest on a pixel's centre": make_track(spot),
            "without duration": make_track(spot, time=np.zeros(20)),
            "empty": make_track(line(20), 0.0, height=1.0),
            "height and force 0": make_track(line(20), 0.0, height=0.0),
            "nothing valid": make_track(line(20), valid=np.zeros(20)),
            "bristles on one spot": make_track(np.repeat(spot, BRISTLES, axis=2)),
            "bristles on one path": make_track(same),
            "single stamp": make_track(line(20)[:1]),
            "straight back": make_track(back),
            "off the grid": moved(make_track(line(20)), (1e4, -1e4)),
            "far off": moved(make_track(line(20)), (-1e12, 1e12)),
            "over the border": moved(make_track(line(20)), (-3.0, -3.0)),
            "tiny steps": make_track(3.0 + 1e-7 * line(20)),
            "huge steps": make_track(1e3 * (line(20) - 3.0)),
            "lifted at once": make_track(line(20), 1e4 * (np.arange(20) % 2)[:, None], height=50.0),
        }
        for name, track in cases.items():
            (total, maps), slopes = run(track)
            for leaf in jax.tree.leaves((total, maps, slopes)):
                assert np.all(np.isfinite(np.asarray(leaf))), name
        assert all(not np.any(x) for _, x in leaves(soft_maps(cases["off the grid"]))[:-1])
        assert all(not np.any(x) for _, x in leaves(soft_maps(cases["empty"]))[:-1])


@pytest.mark.slow
def test_vmap_is_a_loop(x64):
    tracks = [random_track(seed, stamps=12, leap=0.0) for seed in range(3)]
    color = jnp.asarray(colors(BRISTLES))
    one = lambda t: trajectory_maps(canvas(), t, color, width=WIDTH, edge=EDGE)  # noqa: E731
    batch = jax.jit(jax.vmap(one))(stack(tracks))
    for k, track in enumerate(tracks):
        for (name, a), (_, b) in zip(leaves(batch), leaves(soft_maps(track)), strict=True):
            np.testing.assert_allclose(a[k], b, atol=1e-9, err_msg=name)


@pytest.mark.slow
def test_jit_is_op_by_op(x64):
    track, grid = make_track(line(20)[:3]), canvas((0.5, 2.5), 12)
    with jax.disable_jit():
        plain = trajectory_maps(grid, track, width=WIDTH, edge=EDGE)
    got = draw(grid, track, width=WIDTH, edge=EDGE)
    assert np.any(got.coverage)
    for (name, a), (_, b) in zip(leaves(got), leaves(plain), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9, err_msg=name)


def test_other_strokes_do_not_compile(x64):
    run(random_track(0))
    compiled = both._cache_size()
    run(random_track(5, stamps=31))
    assert both._cache_size() == compiled


@pytest.mark.slow
def test_slope_reaches_the_hand(x64, key):
    config = BrushConfig(nodes=6, approach=4)
    params = make_brush(key, config, "flat", 8)
    s = np.linspace(0.0, 1.0, 12)
    path = np.stack([1.5 + 3.0 * s, 3.0 + 0.5 * np.sin(3.0 * s)], axis=1)
    stroke = make_stroke(path, 0.03 * s, 0.3 + 0.2 * s, altitude=1.2, azimuth=np.pi)
    weights = [jnp.asarray(WEIGHTS[name]) for name in ("pressure", "sweeps", "time", "coverage")]

    @jax.jit
    def slope(position, pressure):
        def total(position, pressure):
            here = dataclasses.replace(stroke, position=position, pressure=pressure)
            maps = trajectory_maps(canvas(), rollout(config, params, here), edge=0.3, longest=1.0)
            found = (maps.pressure, maps.sweeps, maps.time, maps.coverage)
            return sum(jnp.sum(w * x) for w, x in zip(weights, found, strict=True)), maps

        return jax.value_and_grad(total, (0, 1), has_aux=True)(position, pressure)

    (_, maps), slopes = slope(stroke.position, stroke.pressure)
    assert bool(maps.whole) and np.asarray(maps.coverage).max() > 0.9
    assert_finite(slopes)
    rng, errors = np.random.default_rng(1), []
    for _ in range(6):
        ways = rng.normal(size=(12, 2)), 0.1 * rng.normal(size=12)
        h = 1e-7
        ends = [
            float(slope(stroke.position + t * h * ways[0], stroke.pressure + t * h * ways[1])[0][0])
            for t in (1.0, -1.0)
        ]
        difference = (ends[0] - ends[1]) / (2 * h)
        found = float(sum(jnp.sum(a * b) for a, b in zip(slopes, ways, strict=True)))
        errors.append(abs(found - difference) / max(abs(difference), 1e-9))
    print(f"hand to maps: relative errors of the slope {np.round(errors, 6)}")
    # Touch, stick and slip have kinks: a step across one spoils a direction, not most of them.
    assert np.median(errors) < 1e-3
