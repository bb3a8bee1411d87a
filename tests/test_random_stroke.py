"""Random strokes: sound, artist-like, and one stroke a key."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbrush import stylus

_draw = jax.jit(jax.vmap(lambda *a: stylus.random_stroke(a[0], 128, *a[1:]), (0, None, None)))


def draw(seed, kind, extent=(60.0, 60.0)):
    """Draws 64 strokes of one kind."""
    keys = jax.random.split(jax.random.key(seed), 64)
    strokes = _draw(keys, jnp.array(extent), jnp.array(stylus.KINDS.index(kind)))
    return jax.tree.map(np.asarray, strokes)


@pytest.fixture(scope="module")
def crowd():
    strokes = jax.jit(jax.vmap(stylus.random_stroke))(jax.random.split(jax.random.key(0), 256))
    return jax.tree.map(np.asarray, strokes)


def assert_close(a, b, atol=1e-5):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(np.asarray(x, float), np.asarray(y, float), atol=atol)


def assert_finite(tree):
    assert all(np.isfinite(np.asarray(x, float)).all() for x in jax.tree.leaves(tree))


def speeds(strokes):
    way = np.linalg.norm(np.diff(strokes.position, axis=1), axis=-1)
    return way / np.diff(strokes.time, axis=1)


def test_random_strokes_are_sound(crowd):
    assert_finite(crowd)
    assert np.all(crowd.valid)
    assert np.all(crowd.time[:, 0] == 0) and np.all(np.diff(crowd.time, axis=1) > 0)
    assert crowd.position.min() >= 0 and crowd.position.max() <= 60
    assert crowd.pressure.min() > 0 and crowd.pressure.max() <= 0.8 + 1e-6
    assert np.deg2rad(45) < crowd.altitude.min() and crowd.altitude.max() < np.deg2rad(80)
    # The hand is to the lower right of a right-handed painter's brush.
    assert 0 < crowd.azimuth.min() and crowd.azimuth.max() < np.pi / 2


def test_random_strokes_are_as_fast_and_long_as_a_hand(crowd):
    duration = crowd.time[:, -1]
    assert 0.15 < np.median(duration) < 0.45 and duration.max() < 3.0
    speed = np.repeat(speeds(crowd), np.ceil(duration / 0.008).astype(int), axis=0).ravel()
    assert 65 < np.median(speed) < 115  # recorded: 88 mm/s
    assert 200 < np.percentile(speed, 95) < 360  # recorded: 280 mm/s
    assert speed.max() < 477


def test_random_pressure_rises_wanders_and_falls(crowd):
    peak = crowd.pressure.max(axis=1)
    assert 0.37 < np.median(peak) < 0.55
    assert 0.25 < np.median(np.ptp(crowd.pressure, axis=1)) < 0.5  # recorded: 0.30
    assert np.all(crowd.pressure[:, 0] < 0.6 * peak)
    assert np.all(crowd.pressure[:, -1] < 0.6 * peak)
    assert np.abs(np.diff(crowd.pressure, axis=1)).max() < 0.15


def test_random_tilt_drifts_slowly(crowd):
    for angle in (crowd.altitude, crowd.azimuth, crowd.twist):
        spread = np.ptp(angle, axis=1)
        assert 0.01 < np.median(spread) < 0.4
        assert np.abs(np.diff(angle, axis=1)).max() < 0.05


def test_random_hand_is_slow_at_corners_and_at_both_ends():
    scribbles = draw(1, "scribble")
    speed = speeds(scribbles)
    step = np.diff(scribbles.position, axis=1)
    bend = np.abs(np.diff(np.unwrap(np.arctan2(step[..., 1], step[..., 0])), axis=1))
    curvature = bend / np.linalg.norm(step[:, 1:], axis=-1)
    middle = slice(25, 100)  # away from the slow ends
    for v, k in zip(speed[:, 1:][:, middle], curvature[:, middle], strict=True):
        order = np.argsort(k)
        assert v[order[-10:]].mean() < 0.8 * v[order[:10]].mean()
    v = speeds(draw(1, "straight"))
    assert np.all(v[:, 0] < 0.8 * v.max(axis=1)) and np.all(v[:, -1] < 0.8 * v.max(axis=1))


def test_kinds_differ_in_turning_and_length():
    total, net, length = {}, {}, {}
    for kind in stylus.KINDS:
        position = draw(2, kind, (100.0, 100.0)).position.astype(float)
        step = np.diff(position[:, ::3], axis=1)
        turn = np.diff(np.unwrap(np.arctan2(step[..., 1], step[..., 0]), axis=1), axis=1)
        total[kind] = np.median(np.abs(turn).sum(axis=1))
        net[kind] = np.median(np.abs(turn.sum(axis=1)))
        length[kind] = np.median(np.linalg.norm(step, axis=-1).sum(axis=1))
    assert total["straight"] < 0.5 < total["arc"] < total["s_curve"] < 0.5 * total["scribble"]
    assert net["arc"] > 0.85 * total["arc"]
    assert net["s_curve"] < 0.3 * total["s_curve"]
    assert net["hook"] > 1.5
    assert length["dab"] < 4 < 15 < length["straight"] < 0.5 * length["scribble"]


def test_extent_bounds_each_side():
    position = draw(3, "scribble", (30.0, 8.0)).position
    assert position.min() >= 0 and position[..., 0].max() <= 30 and position[..., 1].max() <= 8
    assert np.ptp(position, axis=1)[:, 1].max() > 7


def test_a_key_gives_one_stroke_everywhere(crowd):
    keys = jax.random.split(jax.random.key(0), 256)
    alone = jax.jit(stylus.random_stroke)(keys[7])
    # The sum along the path rounds differently when batched: up to 0.14 um on JAX 0.12.
    assert_close(jax.tree.map(lambda x: x[7], crowd), alone, atol=2e-4)
    assert np.abs(crowd.position[7] - crowd.position[8]).max() > 0.1


def test_random_stroke_refuses_what_it_cannot_draw():
    key = jax.random.key(0)
    with pytest.raises(ValueError, match="kind is 6, expected an index below 6"):
        stylus.random_stroke(key, kind=6)
    with pytest.raises(ValueError, match="count is 1, expected at least 2"):
        stylus.random_stroke(key, count=1)
