"""The two networks of Wu et al. 2018 (section 4.3 and appendix): U-Net generator, PatchGAN
discriminator.

What the paper leaves open is chosen here: N is instance normalisation (its text; its appendix says
batch normalisation, which is the same at batch 1 while training) with a learned scale and offset;
skips leave the encoder after its ReLU; padding is 1 before and 2 after; leaky slope 0.2; kernels
start as N(0, 0.02).

An output pixel of the generator sees 39, 39, 35 or 35 input pixels along an axis where its index
modulo 4 is 0, 1, 2 or 3: 14, 15, 12 or 13 before it and 24, 23, 22 or 21 after. Beyond, only the
moments of the normalisation carry anything. A logit of the discriminator sees 37.
"""

import dataclasses
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

from jaxbrush import mixing
from jaxbrush.convolutions import KERNEL, UPSAMPLING, convolve, convolve_up
from jaxbrush.structs import config

NORMS = ("instance", "batch", "masked", "none")
DTYPES = ("float32", "bfloat16")
EPSILON = 1e-5
"""Floor of the variance: what a blank map is amplified by is at most 1 / sqrt(EPSILON)."""
MOMENTUM = 0.99
"""Of the running averages of batch normalisation."""


def _normal(key, shape, dtype=jnp.float32, spread=0.02):
    # Drawn flat: XLA's CPU backend compiles that many times faster.
    return spread * jax.random.normal(key, (math.prod(shape),), dtype).reshape(shape)


def _kept(key, shape, dtype=jnp.float32):
    """A start that keeps the spread of what passes through a ReLU (He et al. 2015)."""
    return _normal(key, shape, dtype, math.sqrt(2.0 / math.prod(shape[:-1])))


def _check(options):
    if options.norm not in NORMS:
        raise ValueError(f"norm = {options.norm!r}: expected one of {NORMS}")
    if options.dtype not in DTYPES:
        raise ValueError(f"dtype = {options.dtype!r}: expected one of {DTYPES}")
    if not options.width > 0.0:
        raise ValueError(f"width = {options.width}: expected a number above 0")


@config
class GeneratorConfig:
    """outputs: channels, 1 for height, 3 for color, 4 for color and height. width: factor on the
    channels between. norm: one of NORMS. upsampling: "resize" or "transposed". dtype: of the
    convolutions; parameters, moments and the output are float32 in any case. mixes: of color,
    whether the network says how much of which paint is seen (`mixing`), in place of a color."""

    outputs: int = 1
    width: float = 1.0
    norm: str = "instance"
    upsampling: str = "resize"
    dtype: str = "float32"
    mixes: bool = False

    def __post_init__(self):
        _check(self)
        if self.outputs < 1:
            raise ValueError(f"outputs = {self.outputs}: expected at least 1")
        if self.mixes and self.outputs not in (3, 4):
            raise ValueError(f"mixes with outputs = {self.outputs}: expected 3, a color, or 4")
        if self.upsampling not in UPSAMPLING:
            raise ValueError(
                f"upsampling = {self.upsampling!r}: expected one of {tuple(UPSAMPLING)}"
            )


@config
class DiscriminatorConfig:
    """width, norm, dtype: as in GeneratorConfig."""

    width: float = 1.0
    norm: str = "instance"
    dtype: str = "float32"

    def __post_init__(self):
        _check(self)


def check_size(shape):
    """Raises ValueError unless `shape` (..., h, w, c) has sides that are multiples of 4."""
    if shape[-3] % 4 or shape[-2] % 4 or 0 in shape:
        raise ValueError(
            f"picture of {shape[-3:-1]} pixels: expected sides that are multiples of 4"
        )


def moments(x, weights, axes):
    """Mean and variance of x over `axes`, kept, in float32 and in two passes: one pass cancels
    where the mean is far larger than the spread.

    Args:
      x: (n, h, w, c). weights: (n, h, w, 1), at least 0, or None where all pixels count the same.
        Where they are 0 all over, all pixels count the same.
    """
    x = x.astype(jnp.float32)
    if weights is None:
        mean = jnp.mean(x, axes, keepdims=True)
        return mean, jnp.mean(jnp.square(x - mean), axes, keepdims=True)
    total = jnp.sum(weights, axes, keepdims=True)
    weights = jnp.where(total > 0.0, weights, 1.0)
    weights = weights / jnp.sum(weights, axes, keepdims=True)
    mean = jnp.sum(weights * x, axes, keepdims=True)
    return mean, jnp.sum(weights * jnp.square(x - mean), axes, keepdims=True)


def _reduced(weights, height: int):
    """Weights (n, h, w, 1) averaged down to a map of `height` rows."""
    n, h, w, _ = weights.shape
    k = h // height
    return weights.reshape(n, h // k, k, w // k, k).mean((2, 4))[..., None]


class Norm(nn.Module):
    """Normalisation by the moments of a picture, of the batch, or by running averages."""

    kind: str
    dtype: str

    @nn.compact
    def __call__(self, x, weights, pooled, train):
        scale = self.param("scale", nn.initializers.ones, (x.shape[-1],))
        offset = self.param("offset", nn.initializers.zeros, (x.shape[-1],))
        if weights is not None:
            weights = _reduced(weights, x.shape[1])
        if self.kind != "batch":
            mean, variance = moments(x, weights, (0, 1, 2) if pooled else (1, 2))
            if not self.is_initializing():
                self.sow("seen", "moments", (mean, variance))
        else:
            shape = (1, 1, 1, x.shape[-1])
            means = self.variable("moments", "mean", jnp.zeros, shape, jnp.float32)
            variances = self.variable("moments", "variance", jnp.ones, shape, jnp.float32)
            mean, variance = means.value, variances.value
            if train:
                mean, variance = moments(x, None, (0, 1, 2))
                if not self.is_initializing():
                    means.value += (1.0 - MOMENTUM) * (mean - means.value)
                    variances.value += (1.0 - MOMENTUM) * (variance - variances.value)
        factor = jax.lax.rsqrt(variance + EPSILON) * scale[None, None, None]
        y = (x.astype(jnp.float32) - mean) * factor + offset[None, None, None]
        return y.astype(self.dtype)


class Conv(nn.Module):
    """CnSm, or RCn with factor 2 where `upsampling` is given, then N where a norm is."""

    channels: int
    dtype: str
    stride: int = 1
    upsampling: str | None = None
    norm: str = "none"
    start: Callable = _normal

    @nn.compact
    def __call__(self, x, weights=None, pooled=False, train=False):
        kernel = self.param("kernel", self.start, (KERNEL, KERNEL, x.shape[-1], self.channels))
        kernel = kernel.astype(self.dtype)
        if self.upsampling:
            x = convolve_up(x, kernel, self.upsampling, fast=train)
        else:
            x = convolve(x, kernel, self.stride, fast=train)
        if self.norm != "none":
            return Norm(self.norm, self.dtype, name="norm")(x, weights, pooled, train)
        bias = self.param("bias", nn.initializers.zeros, (self.channels,))
        return x + bias.astype(self.dtype)[None, None, None]


def _channels(options, count: int) -> int:
    return max(1, round(options.width * count))


def _weights_of(options, weights):
    if options.norm == "masked" and weights is None:
        raise ValueError("weights = None: masked normalisation needs the weights of the pixels")
    # Batch moments are averages over many strokes, where one stroke's weights mean nothing.
    return None if options.norm in ("batch", "none") else weights


class Generator(nn.Module):
    """C64S1-ReLU-C128S2-N-ReLU-C128S1-N-ReLU-C256S2-N, then
    ReLU-RC128S2-N-ReLU-RC128S1-N-ReLU-RC64S2-N-ReLU-RCkS1-tanh, with skips between mirror layers.

    One that mixes has as many filters in its last layer as there are paints, and no tanh (but for
    the height, where it paints that, too); its first layer does not see the colors among its
    inputs, only the mixture does (`mixing`).

    Call it by `apply(variables, inputs, weights, pooled=, train=)`:

    Args:
      inputs: (n, h, w, c) in [-1, 1], h and w multiples of 4.
      weights: (n, h, w, 1) of the pixels in the moments of "instance" (optional) and "masked".
      pooled: whether the batch holds patches of one stroke that share their moments; a pixel that
        is in several patches has to share its weight among them.
      train: batch moments in place of their running averages, which `mutable=["moments"]` returns;
        and on a CPU the fewer products of `winograd` in wide layers.

    Returns:
      (n, h, w, outputs) float32 in [-1, 1].

    Raises:
      ValueError: sides that are no multiples of 4, or masked normalisation without weights.
    """

    config: GeneratorConfig

    @nn.compact
    def __call__(self, inputs, weights=None, *, pooled: bool = False, train: bool = False):
        c = self.config
        check_size(inputs.shape)
        weights = _weights_of(c, weights)

        # Nothing else sets the scale where there is no normalisation.
        begin = _kept if c.norm == "none" else _normal

        def layer(name, x, count, stride=1, norm=c.norm, up=None):
            conv = Conv(_channels(c, count), c.dtype, stride, up, norm, begin, name=name)
            return nn.relu(conv(x, weights, pooled, train))

        def join(*parts):
            return jnp.concatenate(parts, axis=-1)

        x = (inputs[..., mixing.COLORS :] if c.mixes else inputs).astype(c.dtype)
        first = layer("encode1", x, 64, norm="none")
        second = layer("encode2", first, 128, stride=2)
        third = layer("encode3", second, 128)
        x = layer("encode4", third, 256, stride=2)
        x = layer("decode1", x, 128, up=c.upsampling)
        x = layer("decode2", join(x, third), 128)
        x = layer("decode3", join(x, second), 64, up=c.upsampling)
        outputs = mixing.PAINTS + c.outputs - 3 if c.mixes else c.outputs
        x = Conv(outputs, c.dtype, name="decode4")(join(x, first)).astype(jnp.float32)
        if not c.mixes:
            return jnp.tanh(x)
        height = inputs[..., -1:] if c.outputs == 3 else jnp.tanh(x[..., mixing.PAINTS :])
        color = mixing.mix(x[..., : mixing.PAINTS], inputs, height)
        return color if c.outputs == 3 else join(color, height)


def inputs_of(options: GeneratorConfig, params: dict) -> int:
    """How many input channels a generator of these parameters takes."""
    seen = params["encode1"]["kernel"].shape[2]
    return seen + mixing.COLORS if options.mixes else seen


class Discriminator(nn.Module):
    """C64S1-LReLU-C128S2-N-LReLU-C256S2-N-LReLU-C512S1-N-LReLU-C1S1; the sigmoid is in the loss.

    Call it by `apply(variables, picture, inputs, weights)`:

    Args:
      picture: (n, h, w, k), real or generated. inputs: (n, h, w, c), what the generator was given.
      weights: (n, h, w, 1) of the pixels in the moments of "instance" (optional) and "masked".

    Returns:
      (n, h / 4, w / 4, 1) float32 logits, positive where a patch looks real.

    Raises:
      ValueError: as the generator.
    """

    config: DiscriminatorConfig

    @nn.compact
    def __call__(self, picture, inputs, weights=None):
        c = self.config
        check_size(picture.shape)
        weights = _weights_of(c, weights)
        # Moments of the batch at hand: this network is only ever used in training.
        norm, pooled = ("instance", True) if c.norm == "batch" else (c.norm, False)
        x = jnp.concatenate([picture.astype(c.dtype), inputs.astype(c.dtype)], axis=-1)
        for index, (count, stride) in enumerate(((64, 1), (128, 2), (256, 2), (512, 1)), 1):
            kind = norm if index > 1 else "none"
            conv = Conv(_channels(c, count), c.dtype, stride, None, kind, name=f"layer{index}")
            x = nn.leaky_relu(conv(x, weights, pooled, True), 0.2)
        return Conv(1, c.dtype, name="layer5")(x).astype(jnp.float32)


def folded(options: GeneratorConfig, variables: dict, pictures) -> tuple[GeneratorConfig, dict]:
    """A generator without normalisation that does what one with "instance" does at the mean moments
    of some pictures. It sees what is near a pixel and nothing else: parts of a picture can be
    painted one by one.

    Args:
      pictures: batches of inputs (n, h, w, c), as many as represent what it is used on.

    Returns:
      Its config and variables.

    Raises:
      ValueError: another norm, or no pictures.
    """
    if options.norm != "instance":
        raise ValueError(f"norm = {options.norm!r}: expected 'instance'")

    @jax.jit
    def look(variables, inputs):
        _, found = Generator(options).apply(variables, inputs, mutable=["seen"])
        return {name: layer["norm"]["moments"][0] for name, layer in found["seen"].items()}

    seen = [jax.device_get(look(variables, inputs)) for inputs in pictures]
    if not seen:
        raise ValueError("no pictures: expected some to take the moments from")
    params = {}
    for name, layer in variables["params"].items():
        if name not in seen[0]:
            params[name] = layer
            continue
        mean, variance = (np.concatenate([s[name][k] for s in seen])[:, 0, 0] for k in (0, 1))
        # Of all pixels of all pictures.
        spread = np.sqrt(variance.mean(0) + mean.var(0) + EPSILON)
        factor = layer["norm"]["scale"] / spread
        params[name] = {
            "kernel": layer["kernel"] * factor[None, None, None],
            "bias": layer["norm"]["offset"] - mean.mean(0) * factor,
        }
    return dataclasses.replace(options, norm="none"), {"params": params}
