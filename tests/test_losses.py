import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbrush import losses
from jaxbrush.canvas import OPACITY
from jaxbrush.mixing import LEVEL


def test_l1_is_a_mean_over_everything():
    true = jnp.zeros((2, 4, 4, 3))
    assert float(losses.l1(true + 0.5, true)) == 0.5
    assert float(losses.l2(true + 0.5, true)) == 0.25


def test_least_squares_keep_the_paint_that_medians_miss():
    """Of what is 0.1 in most places and 1.0 in a few: what one number fits best in either loss."""
    true = jnp.where(jnp.arange(100) < 80, 0.1, 1.0)
    tries = jnp.linspace(0.0, 1.0, 101)
    best = []
    for loss in (losses.l1, losses.l2):
        best.append(tries[jnp.argmin(jax.vmap(loss, (0, None))(tries, true))])
    np.testing.assert_allclose(best, [0.1, 0.28], atol=1e-6)
    assert float(true.mean()) == pytest.approx(0.28)


def test_gradient_counts_what_light_sees():
    """Grooves of 4 pixels and waves of 32 with the same error of heights: the grooves' slopes, and
    their loss, are 50 times as large. A height that is off everywhere alike is none."""
    x = jnp.arange(64.0)[None, None, :, None] * jnp.ones((1, 64, 1, 1))
    flat = jnp.zeros_like(x)
    fine, wide = (jnp.sin(2.0 * jnp.pi * x / wave + 0.25 * jnp.pi) for wave in (4.0, 32.0))
    assert float(losses.l2(fine, flat)) == pytest.approx(float(losses.l2(wide, flat)), rel=1e-3)
    steep = [float(losses.gradient(wave, flat)) for wave in (fine, wide)]
    expected = [2.0 * np.sin(np.pi / wave) ** 2 for wave in (4.0, 32.0)]
    np.testing.assert_allclose(steep, expected, rtol=0.02)
    assert float(losses.gradient(flat + 0.3, flat)) == 0.0
    turned = losses.gradient(fine.swapaxes(1, 2), flat)
    assert float(turned) == pytest.approx(steep[0], rel=1e-5)


def test_opacity_counts_what_is_seen():
    """10 um of paint more: a third of the light on a canvas that is nearly bare, nothing on a thick
    film; less than no paint is none, and its slope is finite."""
    height = lambda mm: jnp.full((1, 4, 4, 1), 2.0 * mm / LEVEL - 1.0)  # noqa: E731
    light = [float(losses.opacity(height(h + 0.01), height(h))) for h in (0.0, 0.03, 0.3)]
    through = [np.exp(-h / OPACITY) - np.exp(-(h + 0.01) / OPACITY) for h in (0.0, 0.03, 0.3)]
    np.testing.assert_allclose(light, through, rtol=1e-3, atol=1e-7)
    assert light[0] > 0.25 and light[2] < 1e-4
    assert float(losses.opacity(height(-0.1), height(0.0))) == 0.0
    for h in (-0.1, 0.0, 1.25):
        assert np.isfinite(jax.grad(losses.opacity)(height(h), height(0.0))).all()


def test_adversarial_losses_are_the_logarithms_of_the_paper(x64):
    real, fake = jnp.array([0.3, -2.0, 1.5]), jnp.array([0.7, -0.1])
    d = jax.nn.sigmoid
    expected = -np.mean(np.log(d(real))) - np.mean(np.log(1.0 - d(fake)))
    assert float(losses.tell_apart(real, fake)) == pytest.approx(expected, rel=1e-12)
    assert float(losses.fool(fake)) == pytest.approx(-np.mean(np.log(d(fake))), rel=1e-12)
    undecided = losses.tell_apart(jnp.zeros(3), jnp.zeros(3))
    assert float(undecided) == pytest.approx(2 * np.log(2))


def test_logits_keep_what_a_sigmoid_loses():
    """At a logit of -200 the probability is 0 in float32, and its logarithm has no slope left."""
    sure = jnp.full(4, -200.0)
    naive, lost = jax.value_and_grad(lambda x: -jnp.mean(jnp.log(jax.nn.sigmoid(x))))(sure)
    assert not np.isfinite(naive) or not np.isfinite(lost).all()
    value, slope = jax.value_and_grad(losses.fool)(sure)
    assert float(value) == pytest.approx(200.0)
    np.testing.assert_allclose(slope, -0.25)
    real, fake = jax.grad(losses.tell_apart, (0, 1))(sure, -sure)
    np.testing.assert_allclose(real, -0.25)
    np.testing.assert_allclose(fake, 0.25)
