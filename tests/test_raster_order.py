"""Which bristle is the latest: order in time, also within a stamp, whatever the order of work."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from raster_cases import (
    BRISTLES,
    SIDE,
    WIDTH,
    assert_same,
    canvas,
    colors,
    draw,
    exact_maps,
    leaves,
    make_track,
    random_track,
    reference,
)

from jaxbrush.raster import FORCE_UNIT, exact, trajectory_maps


def line(stamps, start=(1.0, 3.0), end=(5.0, 3.0)):
    share = np.linspace(0.0, 1.0, stamps)[:, None]
    # Off the middle between pixels: their centres would lie on the very rim.
    return np.asarray(start) + share * (np.asarray(end) - np.asarray(start)) + 0.03


def test_order_of_work_changes_nothing():
    # A bristle that goes the way of another leaves at the same moments.
    twin = lambda x: x.at[..., 5].set(x[..., 0])  # noqa: E731
    track = random_track(3, air=0.2)
    track = dataclasses.replace(track, position=twin(track.position), force=twin(track.force))
    first = exact_maps(track)
    assert_same(exact_maps(track), first)

    order = np.array([4, 5, 0, 2, 1, 3])
    mixed = dataclasses.replace(
        track, position=track.position[..., order], force=track.force[..., order]
    )
    other = exact_maps(mixed, colors(BRISTLES)[order])
    np.testing.assert_array_equal(other.coverage, first.coverage)
    np.testing.assert_array_equal(other.sweeps, first.sweeps)
    alone = ~reference(canvas(), track, WIDTH).tie
    assert 0.5 < alone.mean() < 1.0
    for (name, a), (_, b) in zip(leaves(other)[:-1], leaves(first)[:-1], strict=True):
        np.testing.assert_array_equal(a[alone], b[alone], err_msg=name)
    assert np.any(np.asarray(other.color) != np.asarray(first.color)), "no tie to settle"


def test_ties_go_to_the_higher_bristle():
    path = np.repeat(line(9)[..., None], 3, axis=2)
    color = np.eye(3)
    maps = exact_maps(make_track(path, [10.0, 30.0, 20.0]), np.concatenate([color, color]))
    covered = np.asarray(maps.coverage) > 0
    assert covered.sum() > 90
    assert np.all(np.asarray(maps.color)[covered] == color[2])
    np.testing.assert_allclose(np.asarray(maps.pressure)[covered], 20.0 / FORCE_UNIT, rtol=1e-6)


def test_painting_bristle_by_bristle_gets_the_crossing_wrong():
    # Bristle 0 crosses the path of bristle 1 after it; a loop over bristles paints it first.
    stamps = 41
    down = line(stamps, (3.0, 1.0), (3.0, 5.0))
    path = np.stack([down, line(stamps)], axis=2)
    force = np.full((stamps, 2), 100.0)
    force[: stamps // 4, 0] = 0.0  # bristle 0 comes down later ...
    path[:, :, 1] = line(stamps, (1.0, 3.0), (9.0, 3.0))  # ... than 1 has gone by
    track = make_track(path, force, height=2.0)
    naive = np.zeros((SIDE, SIDE, 3))
    for b in range(2):
        one = make_track(path[:, :, b], force[:, b : b + 1], height=2.0)
        naive[reference(canvas(), one, WIDTH).bristle >= 0] = np.eye(3)[b]
    ours = np.asarray(exact_maps(track, np.eye(3)).color)
    want = reference(canvas(), track, WIDTH).bristle
    assert want[23, 23] == 0
    np.testing.assert_array_equal(naive[23, 23], [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(ours[23, 23], [1.0, 0.0, 0.0])


def flick(stamps, times, bristles=24):
    """A brush of bristles side by side and behind each other, 3 mm from stamp to stamp, and the
    same with `times` stamps for each: (paths (t, 2, b), forces (t, b), times (t,))."""
    rng = np.random.default_rng(4)
    s = np.linspace(0.0, stamps - 1.0, times * (stamps - 1) + 1)
    way = np.stack([0.5 + 3.0 * s, 2.0 + 0.3 * s], axis=1)
    root = rng.uniform((-0.8, -1.0), (0.8, 1.0), (bristles, 2)).T
    force = rng.uniform(20.0, 180.0, bristles) * (1.0 - 0.1 * s[:, None])
    return way[:, :, None] + root, force, 0.01 * s


def test_a_fast_stroke_has_the_order_of_finer_stamps():
    # Failure: within a stamp the bristle of the highest number lies on top, over all of its sweep.
    grid, color = canvas((2.0, 0.0)), np.random.default_rng(5).uniform(0.1, 1.0, (24, 3))
    coarse, fine = (make_track(path, force, time=time) for path, force, time in
                    (flick(4, 1), flick(4, 8)))  # fmt: skip
    want = draw(grid, fine, color, width=WIDTH)
    ours = draw(grid, coarse, color, width=WIDTH)
    numbered = reference(grid, coarse, WIDTH, order="number")
    covered = (np.asarray(want.coverage) > 0) & (np.asarray(ours.coverage) > 0)
    covered &= numbered.bristle >= 0
    assert covered.mean() > 0.2

    def off(pressure, colors):
        """Relative rms of pressure, and share of pixels of another color."""
        press = np.asarray(want.pressure)
        error = np.sqrt(np.mean((pressure - press)[covered] ** 2) / np.mean(press[covered] ** 2))
        return error, np.any(colors != np.asarray(want.color), axis=-1)[covered].mean()

    naive = off(numbered.force / FORCE_UNIT, color.astype(np.float32)[numbered.bristle])
    found = off(np.asarray(ours.pressure), np.asarray(ours.color))
    print(f"pressure and color off by {found[0]:.1%}, {found[1]:.1%}; by number {naive[0]:.1%}, "
          f"{naive[1]:.1%}")  # fmt: skip
    assert naive[0] > 0.2 and naive[1] > 0.3
    # What is left are bristles that leave a pixel at one moment, a 64th of a stamp.
    assert found[0] < naive[0] / 2.5 and found[1] < naive[1] / 8.0


def test_more_sweeps_than_keys():
    exact.check_keys(2**13, 2**11)
    t, b = 2**14, 2**11
    leaf = lambda *shape: jax.ShapeDtypeStruct(shape, np.float32)  # noqa: E731
    track = dataclasses.replace(
        random_track(0), time=leaf(t), position=leaf(t, 1, 3, b), force=leaf(t, 1, b),
        reaction=leaf(t, 3), valid=jax.ShapeDtypeStruct((t,), bool),
    )  # fmt: skip
    with pytest.raises(ValueError, match="16384 stamps x 2048 bristles"):
        jax.eval_shape(lambda t: trajectory_maps(canvas(), t), track)


def looked_up_and_worked_out(function, *args):
    """Whether a kernel of the compiled function takes logarithms of what it looks up."""
    text = jax.jit(function).lower(*args).compile().as_text()
    kernels = re.findall(r"^%\S+ \(.*?^}", text, re.MULTILINE | re.DOTALL)
    return any(" log(" in kernel and " gather(" in kernel for kernel in kernels)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="how XLA's CPU back end fuses")
def test_what_bristles_carry_is_not_worked_out_at_every_pixel():
    track, grid = random_track(2), canvas()
    carried = jnp.ones((*track.position.shape[:1], track.position.shape[3], 3))
    pixel = jnp.zeros((SIDE, SIDE), jnp.int32)
    drawn = lambda x: trajectory_maps(grid, track, jnp.log(x), width=WIDTH).color  # noqa: E731
    assert not looked_up_and_worked_out(drawn, carried)
    naive = lambda x, at: jnp.log(x)[at, at]  # noqa: E731
    assert looked_up_and_worked_out(naive, carried, pixel)
