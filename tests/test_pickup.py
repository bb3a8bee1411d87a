"""What bristles pick up along their way, against closed forms."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbrush.brush import BristleTrack
from jaxbrush.canvas import Canvas, absorbed
from jaxbrush.pickup import FADES, THICK, picked_up

PIXEL, COAT = 0.125, 0.2
RED, GREEN = (0.7, 0.1, 0.05), (0.05, 0.4, 0.1)
pick = jax.jit(picked_up, static_argnums=(2, 3))


def pulled(step=0.125, length=12.0, high=0.0, y=(1.0, 2.0), x=0.5):
    """Bristles pulled along x, stamps `step` apart [mm]."""
    way = np.arange(0.0, length + 1e-9, step)
    tip = np.empty((len(way), 1, 3, len(y)))
    tip[:, 0, 0] = x + way[:, None]
    tip[:, 0, 1] = np.asarray(y)[None]
    tip[:, 0, 2] = high
    return BristleTrack(
        time=jnp.asarray(way / 50.0, jnp.float32),
        position=jnp.asarray(tip, jnp.float32),
        force=jnp.zeros((len(way), 1, len(y))),
        reaction=jnp.zeros((len(way), 3)),
        valid=jnp.ones(len(way), bool),
    )


def canvas(color=RED, height=0.3, width=128):
    shape = (32, width)
    return Canvas(
        height=jnp.full(shape, height),
        color=jnp.broadcast_to(jnp.asarray(color, jnp.float32), (*shape, 3)),
    )


def test_on_thick_paint_the_share_grows_to_one_and_the_color_is_its():
    track = pulled()
    color, share = pick(track, canvas(), PIXEL, COAT)
    way = np.asarray(track.position[:, 0, 0, 0]) - 0.5
    np.testing.assert_allclose(share[:, 0], 1.0 - np.exp(-way / FADES), atol=1e-4)
    assert share[0].max() == 0.0 and np.all(np.asarray(color[0]) == 0.0)
    np.testing.assert_allclose(color[4:], np.broadcast_to(RED, color[4:].shape), atol=1e-4)


def test_thin_paint_gives_less_and_none_nothing():
    whole, half, none = (
        pick(pulled(), canvas(height=h), PIXEL, COAT)[1] for h in (THICK, 0.5 * THICK, 0.0)
    )
    np.testing.assert_allclose(half, 0.5 * whole, atol=1e-6)
    assert float(none.max()) == 0.0


def test_a_band_is_carried_downstream_only_and_fades_as_the_formula():
    """Green from 3 to 4.5 mm on a bare canvas."""
    bare = canvas(GREEN, 0.0)
    band = dataclasses.replace(bare, height=bare.height.at[:, 24:36].set(0.3))
    track = pulled(step=0.03125)
    color, share = pick(track, band, PIXEL, COAT)
    x = np.asarray(track.position[:, 0, 0, 0])
    assert np.all(np.asarray(share)[x < 3.0 - 1e-3] == 0.0)
    behind = x > 4.55
    most = 1.0 - np.exp(-1.5 / FADES)
    np.testing.assert_allclose(
        np.asarray(share)[behind, 0], most * np.exp(-(x[behind] - 4.5) / FADES), rtol=0.03
    )
    np.testing.assert_allclose(
        color[behind, 0], np.broadcast_to(GREEN, (behind.sum(), 3)), atol=1e-4
    )
    # Six millimetres on it is still there: 48 pixels, and a network sees 24.
    assert np.asarray(share)[x > 10.5].min() > 0.05


def test_two_colors_mix_by_their_way_as_paint_does():
    two = canvas(RED)
    two = dataclasses.replace(two, color=two.color.at[:, 36:].set(jnp.asarray(GREEN)))
    track = pulled(step=0.03125)
    color, share = pick(track, two, PIXEL, COAT)
    x = float(track.position[-1, 0, 0, 0])
    red = np.exp(-(x - 4.5) / FADES) * (1.0 - np.exp(-4.0 / FADES))
    green = 1.0 - np.exp(-(x - 4.5) / FADES)
    assert float(share[-1, 0]) == pytest.approx(red + green, rel=0.01)
    mean = (red * absorbed(jnp.asarray(RED)) + green * absorbed(jnp.asarray(GREEN))) / (red + green)
    np.testing.assert_allclose(absorbed(color[-1, 0]), mean, rtol=0.02)


def test_stamps_do_not_matter():
    """Twice as many change nothing but where a pixel begins; a share a stamp would double."""
    few, many = (
        np.asarray(pick(pulled(step=s), canvas(), PIXEL, COAT)[1])[-1, 0] for s in (0.125, 0.0625)
    )
    assert few == pytest.approx(many, rel=1e-4)


@pytest.mark.parametrize("case", ["above", "off the canvas", "padding"])
def test_what_does_not_touch_picks_up_nothing(case):
    track = pulled(high=0.3 + 1.01 * COAT) if case == "above" else pulled()
    if case == "off the canvas":
        track = pulled(y=(-0.1, 4.1), x=0.5)
    if case == "padding":
        track = dataclasses.replace(track, valid=jnp.zeros_like(track.valid))
    color, share = pick(track, canvas(), PIXEL, COAT)
    assert float(share.max()) == 0.0 and float(color.max()) == 0.0
    if case == "above":
        assert float(pick(pulled(high=0.3 + 0.9 * COAT), canvas(), PIXEL, COAT)[1].max()) > 0.5


def test_slopes_in_the_canvas_are_true_and_finite_where_nothing_was_picked_up():
    track = pulled(length=4.0)

    def error(shade, height):
        seen = Canvas(height=canvas().height * height, color=canvas().color * shade)
        return jnp.sum(picked_up(track, seen, PIXEL, COAT)[0])

    slope = jax.jit(jax.grad(error))(1.0, 1.0)
    step = 1e-2
    run = jax.jit(error)
    assert float((run(1.0 + step, 1.0) - run(1.0 - step, 1.0)) / (2 * step)) == pytest.approx(
        float(slope), rel=0.01
    )
    for value in jax.grad(error, (0, 1))(1.0, 0.0):
        assert np.isfinite(value)


def test_compiled_equals_op_by_op_and_batched_equals_alone():
    track, seen = pulled(length=3.0), canvas()
    for a, b in zip(
        pick(track, seen, PIXEL, COAT), picked_up(track, seen, PIXEL, COAT), strict=True
    ):
        np.testing.assert_allclose(a, b, atol=1e-5)
    two = jax.tree.map(lambda *x: jnp.stack(x), seen, canvas(GREEN, 0.05))
    many = jax.vmap(lambda c: picked_up(track, c, PIXEL, COAT))(two)
    for k, c in enumerate((seen, canvas(GREEN, 0.05))):
        for a, b in zip(many, picked_up(track, c, PIXEL, COAT), strict=True):
            np.testing.assert_allclose(a[k], b, atol=1e-5)
