import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxbrush import models
from jaxbrush.convolutions import FEW, UPSAMPLING, convolve, convolve_up
from jaxbrush.models import Discriminator, DiscriminatorConfig, Generator, GeneratorConfig

LAYOUT = ("NHWC", "HWIO", "NHWC")
SMALL = 0.0625


def same(x, kernel, stride):
    return lax.conv_general_dilated(x, kernel, (stride, stride), "SAME", dimension_numbers=LAYOUT)


PLAIN = {
    "stride 1": (lambda x, k: convolve(x, k), lambda x, k: same(x, k, 1)),
    "stride 2": (lambda x, k: convolve(x, k, 2), lambda x, k: same(x, k, 2)),
    "resize": (
        lambda x, k: convolve_up(x, k),
        lambda x, k: same(jnp.repeat(jnp.repeat(x, 2, 1), 2, 2), k, 1),
    ),
    "transposed": (
        lambda x, k: convolve_up(x, k, "transposed"),
        lambda x, k: lax.conv_general_dilated(
            x, k[::-1, ::-1], (1, 1), [(2, 2)] * 2, (2, 2), dimension_numbers=LAYOUT
        ),
    ),
}


def drawn(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def some_variables(network, *args, scale=0.02, **options):
    """Parameters without compiling an initialisation; running moments of 0 and 1."""
    abstract = jax.eval_shape(lambda key: network.init(key, *args, **options), jax.random.key(0))
    rng = np.random.default_rng(0)

    def fill(path, leaf):
        name = path[-1].key
        if name in ("scale", "variance"):
            return jnp.ones(leaf.shape)
        if name in ("offset", "bias", "mean"):
            return jnp.zeros(leaf.shape)
        return jnp.asarray(scale * rng.normal(size=leaf.shape), jnp.float32)

    return jax.tree_util.tree_map_with_path(fill, abstract)


@pytest.mark.parametrize("outs", [5, FEW[0]])  # 8: where XLA's own slope of the kernel is taken
@pytest.mark.parametrize("name", PLAIN)
def test_convolutions_equal_the_plain_forms(name, outs):
    ours, plain = PLAIN[name]
    x, kernel = drawn(2, 8, 12, 3), drawn(4, 4, 3, outs, seed=1)

    def measured(function):
        def value(x, kernel):
            y = function(x, kernel)
            return jnp.sum(jnp.sin(y)), y

        (_, y), slopes = jax.jit(jax.value_and_grad(value, (0, 1), has_aux=True))(x, kernel)
        return y, slopes

    (a, slopes_a), (b, slopes_b) = measured(ours), measured(plain)
    np.testing.assert_allclose(a, b, atol=2e-5)
    for p, q in zip(slopes_a, slopes_b, strict=True):
        np.testing.assert_allclose(p, q, atol=2e-4)


@pytest.mark.parametrize(
    ("ins", "outs", "side"), [(1, 7, 6), (7, 1, 6), (40, 150, 3), (150, 40, 3), (150, 140, 3)]
)
def test_slope_of_a_kernel_by_products_of_matrices(ins, outs, side):
    """Every way of grouping taps: all at once, by row, one by one; either picture moved."""
    from jaxbrush import convolutions as c

    k = 4
    x, kernel = drawn(1, side + k - 1, side + k, ins), drawn(k, k, ins, outs)
    slope = drawn(1, side, side + 1, outs, seed=2)
    found = jax.jit(c._kernel_slope_products)(x, kernel, slope)
    np.testing.assert_allclose(found, c._kernel_slope(x, kernel, slope), atol=1e-4)


@pytest.mark.parametrize(("outs", "products"), [(5, 1), *((n, 0) for n in FEW), (17, 1)])
def test_slopes_of_kernels_with_few_outputs_are_left_to_convolutions(outs, products):
    """By products of matrices they take up to five times as long."""
    x, kernel = drawn(1, 8, 8, 9), drawn(4, 4, 9, outs, seed=1)
    slope = jax.make_jaxpr(jax.grad(lambda k: jnp.sum(convolve(x, k) ** 2)))(kernel)
    assert (" dot_general[" in str(slope)) == bool(products)


def test_the_slope_of_a_picture_is_not_computed_on_its_padding():
    """Plain autodiff computes it there, too: (19 / 16)^2 as many pixels, and throws them away."""
    x, kernel, slope = drawn(1, 16, 16, 32), drawn(4, 4, 32, 32), drawn(1, 16, 16, 32, seed=1)

    def compiled(function):
        pull = jax.jit(lambda x, s: jax.vjp(lambda x: function(x, kernel), x)[1](s))
        return pull.lower(x, slope).compile().as_text()

    def naive(x, kernel):
        x = jnp.pad(x, ((0, 0), (1, 2), (1, 2), (0, 0)))
        return lax.conv_general_dilated(x, kernel, (1, 1), "VALID", dimension_numbers=LAYOUT)

    padded = "f32[1,19,19,32]{3,2,1,0} convolution("
    assert padded in compiled(naive)
    text = compiled(convolve)
    assert padded not in text
    assert "f32[1,16,16,32]{3,2,1,0} convolution(" in text


# The appendix, kernel 4: name, inputs with skips, outputs, followed by N.
LAYERS = [
    ("encode1", "c", 64, False), ("encode2", 64, 128, True), ("encode3", 128, 128, True),
    ("encode4", 128, 256, True), ("decode1", 256, 128, True), ("decode2", 128 + 128, 128, True),
    ("decode3", 128 + 128, 64, True), ("decode4", 64 + 64, "k", False),
]  # fmt: skip
# Kernels 16 * (64c + 139264 + 128k), first bias 64, last k, scale and offset 2 * 832.
COUNTS = {(2, 1): 2_234_049 + 0, (8, 3): 2_244_291}


@pytest.mark.parametrize(("channels", "outputs"), COUNTS)
def test_generator_is_that_of_the_appendix(channels, outputs):
    network = Generator(GeneratorConfig(outputs=outputs))
    x = jnp.zeros((1, 8, 16, channels))
    variables = jax.eval_shape(network.init, jax.random.key(0), x)
    assert list(variables) == ["params"]
    expected = {}
    for name, ins, outs, normed in LAYERS:
        ins, outs = {"c": channels}.get(ins, ins), {"k": outputs}.get(outs, outs)
        one = {"kernel": (4, 4, ins, outs)}
        both = {"norm": {"scale": (outs,), "offset": (outs,)}}
        expected[name] = one | (both if normed else {"bias": (outs,)})
    assert jax.tree.map(lambda p: p.shape, variables["params"]) == expected
    assert sum(math.prod(p.shape) for p in jax.tree.leaves(variables)) == COUNTS[channels, outputs]
    by_hand = 16 * (64 * channels + 139_264 + 128 * outputs) + 64 + outputs + 2 * 832
    assert by_hand == COUNTS[channels, outputs]


def test_sizes_of_the_layers_are_those_of_the_appendix():
    """Full, half, half, quarter; half, half, full, full."""
    network = Generator(GeneratorConfig(width=SMALL))
    x = jnp.zeros((1, 16, 32, 2))
    run = lambda key: network.init_with_output(  # noqa: E731
        key, x, capture_intermediates=lambda m, _: type(m) is models.Conv
    )
    _, variables = jax.eval_shape(run, jax.random.key(0))
    sizes = {
        name: layer["__call__"][0].shape[1:3] for name, layer in variables["intermediates"].items()
    }
    full, half, quarter = (16, 32), (8, 16), (4, 8)
    assert [sizes[name] for name, *_ in LAYERS] == [full, half, half, quarter] + [
        half, half, full, full]  # fmt: skip


def test_discriminator_is_that_of_the_appendix():
    picture, inputs = jnp.zeros((1, 16, 24, 1)), jnp.zeros((1, 16, 24, 2))
    network = Discriminator(DiscriminatorConfig())
    logits, variables = jax.eval_shape(network.init_with_output, jax.random.key(0), picture, inputs)
    assert logits.shape == (1, 4, 6, 1) and logits.dtype == jnp.float32
    shapes = [p["kernel"].shape for _, p in sorted(variables["params"].items())]
    assert shapes == [(4, 4, a, b) for a, b in
                      ((3, 64), (64, 128), (128, 256), (256, 512), (512, 1))]  # fmt: skip
    count = 16 * (3 * 64 + 64 * 128 + 128 * 256 + 256 * 512 + 512) + 64 + 1 + 2 * 896
    assert sum(math.prod(p.shape) for p in jax.tree.leaves(variables)) == count == 2_765_633


@pytest.mark.parametrize("shape", [(1, 8, 10, 2), (1, 6, 8, 2), (0, 8, 8, 2)])
def test_sizes_that_are_no_multiple_of_four_are_refused(shape):
    network = Generator(GeneratorConfig(width=SMALL))
    with pytest.raises(ValueError, match="multiples of 4"):
        jax.eval_shape(network.init, jax.random.key(0), jnp.zeros(shape))


@pytest.mark.parametrize(
    "change", [{"norm": "layer"}, {"dtype": "float16"}, {"width": 0.0}, {"outputs": 0},
               {"upsampling": "bilinear"}]
)  # fmt: skip
def test_unknown_options_are_refused(change):
    (name,) = change
    with pytest.raises(ValueError, match=f"{name} = "):
        GeneratorConfig(**change)


def test_width_scales_the_channels_between():
    network = Generator(GeneratorConfig(width=0.5, outputs=3))
    shapes = jax.eval_shape(network.init, jax.random.key(0), jnp.zeros((1, 4, 4, 8)))["params"]
    assert shapes["encode4"]["kernel"].shape == (4, 4, 64, 128)
    assert shapes["decode4"]["kernel"].shape == (4, 4, 64, 3)


def test_receptive_field_from_gradients():
    """Pixels before and after an output pixel that it depends on, by its index modulo 4."""
    network = Generator(GeneratorConfig(width=SMALL / 2, norm="none"))
    x = jnp.ones((1, 64, 64, 1))
    # Positive weights, so that nothing cancels; small, so that tanh does not saturate.
    variables = jax.tree.map(jnp.abs, some_variables(network, x))

    @jax.jit
    def slope(x, index):
        row = lambda x: network.apply(variables, x)[0, :, 30, 0]  # noqa: E731
        return jax.vjp(row, x)[1](jax.nn.one_hot(index, 64))[0]

    reach = {}
    for index in (28, 29, 30, 31):
        seen = np.flatnonzero(np.abs(slope(x, index)).sum((0, 2, 3)))
        reach[index % 4] = (index - seen[0], seen[-1] - index)
    assert reach == {0: (14, 24), 1: (15, 23), 2: (12, 22), 3: (13, 21)}

    judge = Discriminator(DiscriminatorConfig(width=SMALL / 2, norm="none"))
    weights = jax.tree.map(jnp.abs, some_variables(judge, x, x))
    logit = jax.jit(jax.grad(lambda x: judge.apply(weights, x, x)[0, 8, 7, 0]))
    assert np.count_nonzero(np.abs(logit(x)).sum((0, 2, 3))) == 37


def test_two_pass_variance_holds_where_one_pass_cancels():
    x = 100.0 + 0.01 * drawn(1, 16, 16, 4)
    exact = np.asarray(x, np.float64).var((1, 2), keepdims=True)
    one_pass = jnp.mean(x * x, (1, 2)) - jnp.mean(x, (1, 2)) ** 2
    assert np.max(np.abs(one_pass - exact[:, 0, 0]) / exact[:, 0, 0]) > 1.0
    _, variance = models.moments(x, None, (1, 2))
    np.testing.assert_allclose(variance, exact, rtol=1e-3)
    _, weighted = models.moments(x, jnp.ones((1, 16, 16, 1)), (1, 2))
    np.testing.assert_allclose(weighted, exact, rtol=1e-3)
    assert models.moments(x.astype(jnp.bfloat16), None, (1, 2))[1].dtype == jnp.float32


def test_weights_choose_the_pixels_of_the_moments():
    x = drawn(2, 8, 8, 3)
    half = jnp.zeros((2, 8, 8, 1)).at[:, :, :4].set(2.0)
    mean, variance = models.moments(x, half, (1, 2))
    np.testing.assert_allclose(mean, x[:, :, :4].mean((1, 2), keepdims=True), atol=1e-6)
    np.testing.assert_allclose(variance, x[:, :, :4].var((1, 2), keepdims=True), rtol=1e-5)
    empty = models.moments(x, 0.0 * half, (1, 2))
    for a, b in zip(empty, models.moments(x, None, (1, 2)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("norm", ["instance", "masked"])
def test_blank_and_constant_inputs_give_finite_values_and_slopes(norm):
    """The naive division by the standard deviation of a blank map does not."""
    blank = jnp.zeros((1, 8, 8, 1))
    naive = jax.grad(lambda x: jnp.sum((x - x.mean()) / x.std()))(blank)
    assert not np.isfinite(naive).all()
    network = Generator(GeneratorConfig(width=SMALL, norm=norm))
    x = jnp.zeros((1, 16, 16, 2))
    mask = jnp.zeros((1, 16, 16, 1))
    variables = some_variables(network, x, mask)

    @jax.jit
    def measured(variables, x):
        loss = lambda v, x: jnp.sum(network.apply(v, x, mask) ** 2)  # noqa: E731
        return jax.value_and_grad(loss, (0, 1))(variables, x)

    for value in (0.0, 1.0, -1.0):
        for leaf in jax.tree.leaves(measured(variables, x + value)):
            assert np.isfinite(leaf).all()


def test_pooled_moments_make_a_batch_of_patches_share_them():
    """Two halves of a picture, far enough from their seam, as the whole."""
    network = Generator(GeneratorConfig(width=SMALL))
    x = drawn(1, 32, 96, 1) * jnp.where(jnp.arange(96) < 48, 0.1, 1.0)[None, None, :, None]
    variables = some_variables(network, x)
    run = jax.jit(network.apply, static_argnames="pooled")
    whole = run(variables, x)[0, :, :24]
    patches = jnp.concatenate([x[:, :, :48], x[:, :, 48:]])
    alone = run(variables, patches)[0, :, :24]
    shared = run(variables, patches, pooled=True)[0, :, :24]
    # What is left is the zero padding along the seam, in the moments.
    off = lambda a: float(jnp.sqrt(jnp.mean((a - whole) ** 2)))  # noqa: E731
    assert off(shared) < 0.5 * off(alone)


def test_batch_norm_uses_the_batch_while_training_and_averages_after():
    network = Generator(GeneratorConfig(width=SMALL, norm="batch"))
    twin = Generator(GeneratorConfig(width=SMALL))
    x = drawn(1, 16, 16, 2)
    variables = some_variables(network, x)
    params = {"params": variables["params"]}
    train = jax.jit(lambda v: network.apply(v, x, train=True, mutable=["moments"]))
    y, moved = train({**params, "moments": jax.tree.map(jnp.zeros_like, variables["moments"])})
    # At batch 1 it is instance normalisation (networks with the same parameters).
    np.testing.assert_allclose(y, jax.jit(twin.apply)(params, x), atol=1e-6)
    # From 0, a step moves the averages by a hundredth of the way to where they settle.
    state = jax.tree.map(lambda new: new / (1.0 - models.MOMENTUM), moved["moments"])
    settled = jax.jit(network.apply)({**params, "moments": state}, x)
    np.testing.assert_allclose(settled, y, atol=1e-4)


def test_folded_moments_are_those_of_the_pictures():
    options = GeneratorConfig(width=SMALL)
    one = 0.5 * drawn(2, 32, 64, 3) * jnp.linspace(0.2, 2.0, 64)[None, None, :, None]
    variables = some_variables(Generator(options), one, scale=0.2)
    picture = one[:1]
    whole = Generator(options).apply(variables, picture)
    config, plain = models.folded(options, variables, [picture, picture])
    assert config == dataclasses.replace(options, norm="none")
    np.testing.assert_allclose(Generator(config).apply(plain, picture), whole, atol=1e-4)
    # Moments of a part are others: with them it is painted differently, folded the same.
    part, seen = picture[:, :, :48], np.s_[:, :, :24]
    assert np.abs(Generator(options).apply(variables, part)[seen] - whole[seen]).max() > 0.01
    local = Generator(config).apply(plain, part)
    np.testing.assert_allclose(local[seen], whole[seen], atol=1e-4)
    with pytest.raises(ValueError, match="norm = 'none': expected 'instance'"):
        models.folded(config, plain, [picture])
    with pytest.raises(ValueError, match="no pictures"):
        models.folded(options, variables, [])


def test_masked_norm_needs_weights():
    network = Generator(GeneratorConfig(width=SMALL, norm="masked"))
    with pytest.raises(ValueError, match="weights = None"):
        jax.eval_shape(network.init, jax.random.key(0), jnp.zeros((1, 8, 8, 2)))


def test_bfloat16_keeps_parameters_and_output_in_float32():
    x = drawn(1, 16, 16, 2)
    network = Generator(GeneratorConfig(width=SMALL, dtype="bfloat16"))
    variables = some_variables(network, x)
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(variables))
    exact = Generator(dataclasses.replace(network.config, dtype="float32"))
    y = jax.jit(network.apply)(variables, x)
    assert y.dtype == jnp.float32
    np.testing.assert_allclose(y, jax.jit(exact.apply)(variables, x), atol=0.03)
    slopes = jax.eval_shape(jax.grad(lambda v: jnp.sum(network.apply(v, x))), variables)
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(slopes))


def test_checkerboard_of_transposed_convolution_and_none_of_resize():
    """Of a flat input the interior of a resize network is flat; the transposed one repeats every 2
    or 4 pixels (paper Figure 8)."""
    share = {}
    x = jnp.full((1, 96, 96, 1), 0.5)
    for upsampling in UPSAMPLING:
        network = Generator(GeneratorConfig(width=SMALL, norm="none", upsampling=upsampling))
        variables = some_variables(network, x, scale=0.2)
        y = jax.jit(network.apply)(variables, x)[0, 32:64, 32:64, 0]
        power = np.abs(np.fft.fft2(y)) ** 2
        fine = sum(power[i, j] for i in (0, 8, 16, 24) for j in (0, 8, 16, 24)) - power[0, 0]
        share[upsampling] = fine / power[0, 0]
        # All that varies has those periods.
        assert power.sum() - power[0, 0] - fine < 1e-6 * power[0, 0]
    print(share)
    assert share["transposed"] > 1e-3
    assert share["resize"] < 1e-10
