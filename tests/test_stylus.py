"""Strokes: resampling into stamps, moving, and inventing them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbrush import stylus

EVERY = np.inf  # a time cap that never acts

resample = jax.jit(stylus.resample, static_argnums=1)
stamps_needed = jax.jit(stylus.stamps_needed)


def line(length=10.0, samples=7, duration=0.1):
    x = np.linspace(0.0, 1.0, samples) ** 2 * length  # uneven samples, even stamps
    position = np.stack([x, np.zeros(samples)], axis=-1)
    return stylus.make_stroke(position, np.linspace(0.0, duration, samples))


def circle(samples, radius=5.0, turn=1.5 * np.pi):
    angle = np.linspace(0.0, turn, samples)
    position = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return stylus.make_stroke(position, np.linspace(0.0, 1.0, samples), pressure=0.4)


def curl(samples=12):
    """A smooth stroke in which every field changes."""
    s = np.linspace(0.0, 1.0, samples)
    return stylus.make_stroke(
        position=np.stack([9 * s + 1, 3 * np.sin(4 * s)], axis=-1),
        time=0.3 * s**1.5,
        pressure=0.2 + 0.5 * s * (1 - s),
        altitude=0.8 + 0.3 * s,
        azimuth=0.5 + s,
        twist=1 - 2 * s,
    )


def used(stroke):
    return jax.tree.map(lambda x: np.asarray(x)[np.asarray(stroke.valid)], stroke)


def gaps(stroke):
    return np.linalg.norm(np.diff(used(stroke).position, axis=0), axis=-1)


def assert_close(a, b, atol=1e-5):
    for field in dataclasses.fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        np.testing.assert_allclose(x, y, rtol=1e-5, atol=atol, err_msg=field.name)


def assert_finite(tree):
    for leaf in jax.tree.leaves(tree):
        assert np.all(np.isfinite(leaf))


# make_stroke and pad


def test_make_stroke_broadcasts_scalars():
    stroke = stylus.make_stroke([[1, 2], [3, 4], [5, 6]], pressure=[0.1, 0.2, 0.3], azimuth=2)
    np.testing.assert_allclose(stroke.time, [0.0, 0.008, 0.016], rtol=1e-6)
    np.testing.assert_allclose(stroke.pressure, [0.1, 0.2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(stroke.azimuth, [2, 2, 2])
    np.testing.assert_allclose(stroke.altitude, np.full(3, np.pi / 2), rtol=1e-6)
    assert stroke.valid.dtype == bool and np.all(stroke.valid)
    assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(stroke)[:-1])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("position", np.zeros((3, 3))),
        ("position", np.zeros(2)),
        ("position", np.zeros((0, 2))),
        ("time", np.zeros(4)),
        ("pressure", np.zeros((3, 1))),
        ("twist", np.zeros(2)),
    ],
)
def test_make_stroke_names_the_wrong_argument(name, value):
    arguments = {"position": np.zeros((3, 2))} | {name: value}
    with pytest.raises(ValueError, match=rf"^{name} has shape \({value.shape[0]}.*expected"):
        stylus.make_stroke(**arguments)


def test_pad_repeats_the_last_sample_and_changes_no_stamp():
    stroke = curl()
    padded = stylus.pad(stroke, 20)
    assert int(padded.valid.sum()) == 12
    np.testing.assert_array_equal(padded.position[12:], np.tile(stroke.position[-1], (8, 1)))
    assert_close(resample(padded, 40, 0.5, 0.05), resample(stroke, 40, 0.5, 0.05))
    with pytest.raises(ValueError, match="count is 5, expected at least the stroke's 12"):
        stylus.pad(stroke, 5)


# resample


def test_resample_spaces_a_straight_line_exactly():
    stamps = resample(line(10.25), 64, 0.5, EVERY)
    expected = np.append(np.arange(0, 10.25, 0.5), 10.25)
    assert int(stamps.valid.sum()) == len(expected) == int(stamps_needed(line(10.25), 0.5, EVERY))
    np.testing.assert_allclose(used(stamps).position[:, 0], expected, atol=2e-6)
    np.testing.assert_array_equal(stamps.position[-1], [10.25, 0.0])
    np.testing.assert_array_equal(stamps.position[len(expected) :, 0], np.float32(10.25))


def test_resample_needs_no_stamp_for_rounding():
    # In float32 some of these are a hair more than `steps` steps of 0.1 mm long.
    steps = np.arange(1, 201)
    strokes = [stylus.make_stroke([[0, 0], [0.03 * n, 0], [0.1 * n, 0]]) for n in steps]
    batch = jax.tree.map(lambda *x: np.stack(x), *strokes)
    needed = jax.jit(jax.vmap(lambda s: stylus.stamps_needed(s, 0.1, EVERY)))(batch)
    np.testing.assert_array_equal(needed, steps + 1)


def test_resample_error_on_a_circle_falls_as_the_square_of_the_sample_distance():
    errors = []
    for samples in (33, 65, 129):
        stamps = used(resample(stylus.pad(circle(samples), 129), 512, 0.1, EVERY))
        way = 5.0 * np.unwrap(np.arctan2(stamps.position[:, 1], stamps.position[:, 0]))
        errors.append(np.abs(way[:-1] - 0.1 * np.arange(len(way) - 1)).max())
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(orders, 2.0, atol=0.15)
    assert errors[-1] < 2e-3


def test_time_cap_adds_stamps_where_the_hand_is_slow():
    position = [[0, 0], [0.1, 0], [10, 0]]
    stroke = stylus.make_stroke(position, [0.0, 0.5, 0.6], pressure=[0.0, 1.0, 1.0])
    stamps = used(resample(stroke, 64, 0.5, 0.02))
    assert np.diff(stamps.time).max() < 0.02 * (1 + 1e-4)
    assert np.diff(stamps.position[:, 0]).max() < 0.5 * (1 + 1e-4)
    np.testing.assert_allclose(np.diff(stamps.time)[:24], 0.02, rtol=1e-3)
    np.testing.assert_allclose(stamps.pressure[:25], stamps.time[:25] / 0.5, atol=1e-5)
    assert len(stamps.time) < len(used(resample(stroke, 64, 0.5, 0.01)).time)


def test_a_stroke_with_too_many_stamps_is_spread_and_not_cut():
    stamps = resample(line(10.0), 9, 0.1, EVERY)
    assert np.all(stamps.valid)
    np.testing.assert_allclose(stamps.position[:, 0], np.linspace(0, 10, 9), atol=1e-5)
    assert int(stamps_needed(line(10.0), 0.1, EVERY)) == 101


def test_resampling_stamps_again_keeps_them():
    once = resample(line(10.25), 64, 0.5, EVERY)
    assert_close(resample(once, 64, 0.5, EVERY), once)


def test_angles_take_the_short_way_round():
    turn = np.array([3.0, -3.0, 3.1])
    stroke = stylus.make_stroke([[0, 0], [1, 0], [2, 0]], azimuth=turn, twist=-turn)
    stamps = used(resample(stroke, 64, 0.1, EVERY))
    assert np.abs(np.diff(stamps.azimuth)).max() < 0.03
    np.testing.assert_allclose(stamps.twist, -stamps.azimuth, atol=1e-6)
    np.testing.assert_allclose(np.cos(stamps.azimuth[[0, 10, 20]]), np.cos(turn), atol=1e-5)
    np.testing.assert_allclose(np.sin(stamps.azimuth[[0, 10, 20]]), np.sin(turn), atol=1e-5)


def test_one_sample_is_a_dab_of_one_stamp():
    stamps = resample(stylus.make_stroke([[3, 4]], [7.0], pressure=0.3), 8, 0.5, 0.01)
    np.testing.assert_array_equal(stamps.valid, [True] + 7 * [False])
    np.testing.assert_array_equal(stamps.position, np.tile([3.0, 4.0], (8, 1)))
    assert float(stamps.time[0]) == 7.0


def test_a_resting_pen_gets_stamps_by_time():
    stroke = stylus.make_stroke(np.ones((6, 2)), 0.01 * np.arange(6), pressure=np.linspace(0, 1, 6))
    stamps = used(resample(stroke, 32, 0.5, 0.005))
    np.testing.assert_allclose(stamps.time, 0.005 * np.arange(11), atol=1e-6)
    np.testing.assert_allclose(stamps.pressure, np.linspace(0, 1, 11), atol=1e-5)
    assert len(used(resample(stroke, 32, 0.5, EVERY)).time) == 1


def test_a_stroke_without_samples_has_no_stamps():
    stroke = stylus.make_stroke(np.ones((4, 2)), valid=False)
    assert not np.any(resample(stroke, 8, 0.5, 0.01).valid)
    assert int(stamps_needed(stroke, 0.5, 0.01)) == 0


def test_samples_after_the_valid_ones_do_not_count():
    stroke = curl()
    wild = dataclasses.replace(stroke, valid=jnp.arange(12) < 5)
    stamps = resample(wild, 64, 0.3, 0.05)
    np.testing.assert_array_equal(stamps.position[-1], stroke.position[4])
    head = jax.tree.map(lambda x: x[:5], stroke)
    assert_close(stamps, resample(head, 64, 0.3, 0.05))


@pytest.mark.parametrize(
    ("name", "spacing", "max_dt"), [("spacing", 0.0, 1.0), ("max_dt", 1.0, -1.0)]
)
def test_resample_refuses_bad_steps(name, spacing, max_dt):
    with pytest.raises(ValueError, match=f"{name} is .*expected a number above 0"):
        stylus.resample(curl(), 8, spacing, max_dt)
    with pytest.raises(ValueError, match="count is 1, expected at least 2"):
        stylus.resample(curl(), 1, 1.0, 1.0)


def weigh(stroke, count=40, spacing=0.31, max_dt=0.013):
    """A smooth scalar of all stamps, for gradients."""
    stamps = stylus.resample(stroke, count, spacing, max_dt)
    ramp = jnp.cos(jnp.arange(count, dtype=stamps.time.dtype))
    fields = (*stamps.position.T, stamps.pressure, stamps.altitude, stamps.azimuth, stamps.time)
    return sum(jnp.sum(ramp * x**2 * stamps.valid.astype(x.dtype)) for x in fields)


def test_gradient_matches_finite_differences():
    with jax.enable_x64(True):
        for count in (64, 16):  # stamps to spare, and stamps spread thin
            stroke = jax.tree.map(
                lambda x: x if x.dtype == bool else jnp.asarray(np.asarray(x), jnp.float64), curl()
            )

            def value(position, pressure, stroke=stroke, count=count):
                changed = dataclasses.replace(stroke, position=position, pressure=pressure)
                return weigh(changed, count)

            value = jax.jit(value)
            slope = jax.jit(jax.grad(value, argnums=(0, 1)))(stroke.position, stroke.pressure)
            rng = np.random.default_rng(0)
            for _ in range(4):
                dx, dp = rng.normal(size=(12, 2)), rng.normal(size=12)
                ahead = value(stroke.position + 1e-6 * dx, stroke.pressure + 1e-6 * dp)
                behind = value(stroke.position - 1e-6 * dx, stroke.pressure - 1e-6 * dp)
                along = jnp.sum(slope[0] * dx) + jnp.sum(slope[1] * dp)
                np.testing.assert_allclose(along, (ahead - behind) / 2e-6, rtol=1e-5)


@jax.jit
def stamps_and_slope(stroke, max_dt):
    stamps = stylus.resample(stroke, 40, 0.31, max_dt)
    return stamps, jax.grad(weigh, allow_int=True)(stroke, max_dt=max_dt)


@pytest.mark.parametrize("max_dt", [0.01, EVERY])
@pytest.mark.parametrize(
    "stroke",
    [
        stylus.make_stroke([[3, 4]]),
        stylus.make_stroke(np.ones((5, 2))),
        stylus.make_stroke(np.ones((5, 2)), np.zeros(5)),
        stylus.make_stroke([[0, 0], [0, 0], [1, 0], [1, 0], [2, 0]], [0, 0, 0, 0, 0]),
        stylus.make_stroke(
            [[0, 0], [1e-30, 0], [1e-12, 1e-12], [1, 0], [1, 0]], [0, 1e-30, 1e-3, 1e-3, 1e-3]
        ),
        stylus.make_stroke(np.ones((5, 2)), valid=False),
    ],
    ids=["one", "rest", "frozen", "repeats", "tiny", "none"],
)
def test_no_nan_in_stamps_or_gradients(stroke, max_dt):
    stamps, slope = stamps_and_slope(stroke, max_dt)
    assert_finite(stamps)
    assert_finite([x for x in jax.tree.leaves(slope) if x.dtype == jnp.float32])


def test_resample_under_vmap_and_jit_and_alone_agree():
    strokes = [stylus.pad(s, 16) for s in (curl(), line(), stylus.make_stroke([[1, 2]]))]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *strokes)
    traces = []

    @jax.jit
    def many(batch, spacing):
        traces.append(None)
        return jax.vmap(lambda s: stylus.resample(s, 48, spacing, 0.02))(batch)

    together = many(batch, 0.3)
    for i, stroke in enumerate(strokes):
        alone = resample(stroke, 48, 0.3, 0.02)
        assert_close(jax.tree.map(lambda x, i=i: x[i], together), alone)
    assert_close(stylus.resample(strokes[0], 48, 0.3, 0.02), resample(strokes[0], 48, 0.3, 0.02))
    many(batch, 0.2)
    assert len(traces) == 1


# transform


def frames(stroke):
    """Brush frames (t, 3, 3): the minimal rotation of +z to the axis, after the twist about z."""
    alt, azi, twist = (
        np.asarray(x, float) for x in (stroke.altitude, stroke.azimuth, stroke.twist)
    )
    axis = np.stack([np.cos(alt) * np.cos(azi), np.cos(alt) * np.sin(azi), np.sin(alt)], axis=-1)
    result = []
    for a, angle in zip(axis, twist, strict=True):
        v = np.cross([0, 0, 1], a)
        cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
        swing = np.eye(3) + cross + cross @ cross / (1 + a[2])
        np.testing.assert_allclose(swing @ [0, 0, 1], a, atol=1e-12)
        result.append(swing @ about_z(angle))
    return np.stack(result)


def about_z(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def test_rotation_turns_positions_and_brush_frames_alike():
    stroke, turn, center = curl(), 0.7, np.array([2.0, -1.0])
    moved = stylus.transform(stroke, rotate=turn, center=center)
    r = about_z(turn)
    np.testing.assert_allclose(frames(moved), r @ frames(stroke), atol=1e-6)
    expected = (np.asarray(stroke.position) - center) @ r[:2, :2].T + center
    np.testing.assert_allclose(moved.position, expected, atol=1e-5)


def test_mirror_reflects_positions_and_brush_frames_alike():
    stroke = curl()
    moved = stylus.transform(stroke, mirror=True, center=(4.0, 9.0))
    m = np.diag([-1.0, 1.0, 1.0])
    np.testing.assert_allclose(frames(moved), m @ frames(stroke) @ m, atol=1e-6)
    np.testing.assert_allclose(moved.position[:, 0], 8.0 - stroke.position[:, 0], atol=1e-5)
    np.testing.assert_allclose(moved.position[:, 1], stroke.position[:, 1], atol=1e-5)


def test_mirror_comes_before_the_rotation():
    stroke, turn = curl(), 0.4
    both = stylus.transform(stroke, rotate=turn, mirror=True)
    assert_close(both, stylus.transform(stylus.transform(stroke, mirror=True), rotate=turn))
    m = np.diag([-1.0, 1.0, 1.0])
    np.testing.assert_allclose(frames(both), about_z(turn) @ m @ frames(stroke) @ m, atol=1e-6)


def test_transforms_undo_one_another():
    stroke, center = curl(), (3.0, 5.0)
    turned = stylus.transform(stroke, rotate=1.1, scale=2.0, center=center)
    assert np.abs(turned.position - stroke.position).max() > 1.0
    assert_close(stylus.transform(turned, rotate=-1.1, scale=0.5, center=center), stroke)
    moved = stylus.transform(stroke, translate=(1.0, -2.0))
    np.testing.assert_allclose(
        moved.position - stroke.position, np.tile([1, -2], (12, 1)), atol=1e-5
    )
    assert_close(stylus.transform(moved, translate=(-1.0, 2.0)), stroke)
    twice = stylus.transform(stylus.transform(stroke, mirror=True), mirror=True)
    assert_close(twice, stroke)


def test_scale_leaves_all_but_positions():
    stroke = curl()
    scaled = stylus.transform(stroke, scale=3.0)
    np.testing.assert_allclose(scaled.position, 3.0 * stroke.position, rtol=1e-6)
    assert_close(dataclasses.replace(scaled, position=stroke.position), stroke, atol=0.0)


def test_transform_is_traced_in_every_argument():
    moves = (jnp.array([0.0, 0.7]), jnp.array([[0.0, 0.0], [1.0, 2.0]]), jnp.array([1.0, 2.0]))
    mirror = jnp.array([False, True])
    batch = jax.jit(jax.vmap(stylus.transform, in_axes=(None, 0, 0, 0, 0)))(curl(), *moves, mirror)
    for i in range(2):
        alone = stylus.transform(curl(), *(x[i] for x in moves), bool(mirror[i]))
        assert_close(jax.tree.map(lambda x, i=i: x[i], batch), alone)


def test_way_is_what_stamps_are_counted_by():
    stroke = stylus.make_stroke(
        [(0.0, 0.0), (3.0, 4.0), (3.0, 4.0)], [0.0, 0.1, 0.2], [0.0, 0.0, 0.5]
    )
    np.testing.assert_allclose(stylus.way(stroke, 2.0), [0.0, 5.0, 6.0], rtol=1e-6)
    assert int(stylus.stamps_needed(stroke, 0.25, np.inf, 2.0)) == 25
    stamps = stylus.resample(stroke, 32, 0.25, np.inf, 2.0)
    expected = np.minimum(0.25 * np.arange(32), 6.0)
    np.testing.assert_allclose(stylus.way(stamps, 2.0), expected, atol=1e-5)
