"""What the two players of the training minimise (paper section 4.3)."""

import jax
import jax.numpy as jnp

from jaxbrush.mixing import bare


def l1(found, true):
    """Mean absolute difference of two pictures of the same shape."""
    return jnp.mean(jnp.abs(found - true))


def l2(found, true):
    """Mean squared difference. What it makes is a mean, where L1 makes a median: heights are
    skewed, so their medians miss paint (2 % of it, half of that where strokes end)."""
    return jnp.mean((found - true) ** 2)


def gradient(found, true):
    """Mean squared difference of the differences between neighbours along both axes (of Mathieu et
    al. 2016, squared): what light sees of two pictures of heights. What is finer than a Gaussian of
    2.5 pixels is 7 % of their variance in the masks of test pairs, and 63 % of their gradients'."""
    apart = found - true
    return jnp.mean(jnp.diff(apart, axis=1) ** 2) + jnp.mean(jnp.diff(apart, axis=2) ** 2)


def opacity(found, true):
    """Mean absolute difference of the light that comes through two pictures of heights in network
    scale, from 0 to 1: 10 um more or less are nothing in a thick film, and all there is to see of a
    dry brush."""
    return jnp.mean(jnp.abs(bare(found) - bare(true)))


def fool(fake_logits):
    """The generator's part of the cGAN loss, mean of -log D(G(x), x) over patches.

    The non-saturating form (Goodfellow et al. 2014), as pix2pix has it: the paper's
    log(1 - D(G(x), x)) has no slope where the discriminator wins. From logits, so that no
    logarithm meets a zero.
    """
    return jnp.mean(jax.nn.softplus(-fake_logits))


def tell_apart(real_logits, fake_logits):
    """The discriminator's loss, mean of -log D(y, x) plus mean of -log(1 - D(G(x), x)), from
    logits. A discriminator that cannot tell has 2 log 2."""
    return jnp.mean(jax.nn.softplus(-real_logits)) + jnp.mean(jax.nn.softplus(fake_logits))
