"""Convolutions with fewer products: equal to plain ones, cheaper, and only where they may be."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbrush import winograd
from jaxbrush.convolutions import WIDE, convolve, convolve_up
from jaxbrush.models import Generator, GeneratorConfig


def plain(x, kernel):
    return jax.lax.conv_general_dilated(
        x, kernel, (1, 1), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


def normal(seed, *shape):
    return jax.random.normal(jax.random.key(seed), shape)


def off(a, b):
    """rms of a difference over that of the second."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    return np.sqrt(np.mean((a - b) ** 2) / np.mean(b**2))


@pytest.mark.parametrize("side", [3, 4])
def test_the_matrices_are_those_of_a_correlation(side):
    collect, kernel, picture = (m.astype(np.float64) for m in winograd.transforms(side))
    rng = np.random.default_rng(side)
    g, d = rng.normal(size=side), rng.normal(size=side + 1)
    y = collect.T @ ((kernel @ g) * (picture @ d))
    np.testing.assert_allclose(y, [d[k : k + side] @ g for k in range(2)], atol=1e-6)


def test_another_side_is_refused():
    with pytest.raises(ValueError, match="side = 5: expected 3 or 4"):
        winograd.transforms(5)


@pytest.mark.parametrize("side", [3, 4])
@pytest.mark.parametrize("size", [(1, 1), (6, 9)])
def test_results_and_slopes_equal_the_plain_ones(side, size):
    """Odd and even sizes, and one pixel."""
    h, w = (s + side - 1 for s in size)
    x, k = normal(0, 2, h, w, 24), normal(1, side, side, 24, 20)
    slope = normal(2, 2, *size, 20)
    assert off(winograd.convolve(x, k), plain(x, k)) < 4e-6
    for before, after in ((0, 0), (1, side - 2)):
        inner = x[:, before : h - after, before : w - after]
        padded = ((0, 0), (before, after), (before, after), (0, 0))
        _, pull = jax.vjp(lambda x, k, padded=padded: plain(jnp.pad(x, padded), k), inner, k)
        found = winograd.slopes(inner, k, slope, (before, after))
        for ours, true in zip(found, pull(slope), strict=True):
            assert ours.shape == true.shape
            assert off(ours, true) < 4e-6


@pytest.mark.parametrize("apply", [convolve, convolve_up])
def test_wide_layers_equal_plain_ones_through_second_derivatives(apply):
    x, k = normal(0, 1, 8, 12, WIDE), 0.02 * normal(1, 4, 4, WIDE, WIDE)

    def steepness(x, fast):
        slope = jax.grad(lambda x: jnp.sum(jnp.sin(apply(x, k, fast=fast))))(x)
        return jnp.sum(slope**2)

    assert off(apply(x, k, fast=True), apply(x, k)) < 4e-6
    assert off(jax.grad(steepness)(x, True), jax.grad(steepness)(x, False)) < 2e-5


def flops(function, *args):
    return jax.jit(function).lower(*args).compile().cost_analysis()["flops"]


def test_a_wide_layer_takes_half_the_arithmetic_and_a_narrow_one_is_left_alone():
    for channels, bound in ((WIDE, 0.6), (WIDE // 2, 1.01)):
        x, k = normal(0, 1, 32, 32, channels), normal(1, 4, 4, channels, channels)

        def loss(x, k, fast):
            return jnp.sum(convolve(x, k, fast=fast) ** 2)

        fast, slow = (flops(lambda x, k, f=f: jax.grad(loss)(x, k, f), x, k) for f in (True, False))
        assert fast < bound * slow
        assert channels == WIDE or fast == slow


def test_bfloat16_is_left_alone_because_its_sums_would_lose_bits():
    """Naively it is 3 times as far off as rounding the plain convolution is."""
    x, k = normal(0, 1, 16, 16, WIDE), normal(1, 4, 4, WIDE, WIDE)
    true = convolve(x, k)
    x, k = x.astype(jnp.bfloat16), k.astype(jnp.bfloat16)
    kept = convolve(x, k, fast=True)
    assert np.array_equal(np.asarray(kept), np.asarray(convolve(x, k)))
    padded = jnp.pad(x, ((0, 0), (1, 2), (1, 2), (0, 0)))
    assert off(winograd.convolve(padded, k), true) > 3.0 * off(kept, true)


def test_painting_does_not_use_it_so_that_patches_equal_the_whole():
    """What the trained network says of a pixel must not depend on the pixel's place in a tile."""
    x, k = normal(0, 1, 24, 24, WIDE), normal(1, 4, 4, WIDE, WIDE)
    for fast, same in ((False, True), (True, False)):
        whole = convolve(x, k, fast=fast)[:, 5:17, 5:17]
        patch = convolve(x[:, 3:20, 3:20], k, fast=fast)[:, 2:14, 2:14]
        assert off(patch, whole) < 4e-6
        assert np.array_equal(np.asarray(patch), np.asarray(whole)) == same

    network = Generator(GeneratorConfig(width=1.0))
    inputs = normal(2, 1, 16, 16, 2)
    variables = network.init(jax.random.key(0), inputs)
    wide = [
        str(
            jax.make_jaxpr(lambda v, x, t=t: network.apply(v, x, train=t))(variables, inputs)
        ).count("_convolve_wide")
        for t in (True, False)
    ]
    assert wide == [4, 0]
