import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbrush import losses


def test_l1_is_a_mean_over_everything():
    true = jnp.zeros((2, 4, 4, 3))
    assert float(losses.l1(true + 0.5, true)) == 0.5


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
