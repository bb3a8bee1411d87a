"""The convolutions of the networks: kernel 4, "same" size, stride 1, stride 2 and upsampling by 2.

All three become one kind of convolution, dense with stride 1, by moving blocks of pixels into
channels: that form is fast forward and backward on every backend, where strided and dilated ones
are not. The results equal those of the plain forms up to rounding.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbrush import winograd
from jaxbrush.winograd import pad

KERNEL = 4
"""Side of every kernel (paper, appendix)."""

# What each of the two output pixels of an input pixel i takes from i - 1, i and i + 1, as sums of
# the kernel's weights along an axis: [phase, neighbour, weight].
RESIZE = np.zeros((2, 3, KERNEL), np.float32)
"""Nearest-neighbour upsampling, then a convolution padded by 1 before and 2 after."""
RESIZE[0, 0, 0] = RESIZE[0, 1, 1] = RESIZE[0, 1, 2] = RESIZE[0, 2, 3] = 1.0
RESIZE[1, 1, 0] = RESIZE[1, 1, 1] = RESIZE[1, 2, 2] = RESIZE[1, 2, 3] = 1.0
TRANSPOSED = np.zeros((2, 3, KERNEL), np.float32)
"""Transposed convolution of stride 2, cropped by 1 on both sides."""
TRANSPOSED[0, 0, 3] = TRANSPOSED[0, 1, 1] = TRANSPOSED[1, 1, 2] = TRANSPOSED[1, 2, 0] = 1.0

UPSAMPLING = {"resize": RESIZE, "transposed": TRANSPOSED}


def _valid(x, kernel):
    return lax.conv_general_dilated(
        x, kernel, (1, 1), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


def _kernel_slope(x, kernel, slope):
    return jax.vjp(lambda k: _valid(x, k), kernel)[1](slope)[0]


def _kernel_slope_products(x, kernel, slope):
    """The same as products of matrices, contracted over pixels.

    XLA's CPU backend computes this gradient as a convolution with a kernel of the picture's size,
    at a quarter of its speed. Of the two pictures the one with fewer channels is the one that is
    shifted, by as many taps at once as make the product wide; the other is turned round once, for
    XLA would do it for every product.
    """
    k, _, ins, outs = kernel.shape
    swapped = outs < ins
    still, moving = (x, pad(slope, k - 1, k - 1)) if swapped else (slope, x)
    n, h, w, _ = still.shape
    channels = moving.shape[3]
    turned = still.reshape(n * h * w, -1).T
    starts = range(k - 1, -1, -1) if swapped else range(k)

    def product(wide):
        return jnp.matmul(
            turned, wide.reshape(n * h * w, -1), preferred_element_type=jnp.float32
        )  # fmt: skip

    # Loops, because each product in a row of them would be compiled by itself.
    if k * channels <= 256:
        wide = jnp.concatenate([moving[:, :, x : x + w] for x in starts], axis=-1)
        if k * k * channels <= 256:
            wide = jnp.concatenate([wide[:, y : y + h] for y in starts], axis=-1)
            slopes = product(wide)[None]
        else:
            rows = jnp.asarray(starts, jnp.int32)
            slopes = lax.map(lambda y: product(lax.dynamic_slice_in_dim(wide, y, h, axis=1)), rows)
    else:
        taps = jnp.asarray([(y, x) for y in starts for x in starts], jnp.int32)
        size = (n, h, w, channels)
        slopes = lax.map(
            lambda tap: product(lax.dynamic_slice(moving, (0, tap[0], tap[1], 0), size)), taps
        )
    # (products, still, taps of a product, moving)
    slopes = slopes.reshape(slopes.shape[0], turned.shape[0], -1, channels)
    slopes = slopes.transpose((0, 2, 1, 3) if swapped else (0, 2, 3, 1))
    return slopes.reshape(kernel.shape).astype(kernel.dtype)


FEW = (8, 16)
"""Least and most output channels for which XLA's own slope of the kernel takes a CPU 0.2 to 0.8 of
the time of products of matrices, at 8 to 64 input channels (about the same at 2 to 5, and at 128 up
to 1.0); with 1 or 64 it takes up to five times as long."""


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def _convolve(x, kernel, padding):
    return _valid(pad(x, *padding), kernel)


def _forward(x, kernel, padding):
    return _convolve(x, kernel, padding), (x, kernel)


def _picture_slope(kernel, slope, padding):
    """As a convolution of the slope, of what lies on the picture alone: autodiff computes the
    slope of the padding, too, and throws it away, a fifth of the products of 32 x 32 pixels."""
    edge = kernel.shape[0] - 1
    around = pad(slope, edge - padding[0], edge - padding[1])
    return _valid(around, kernel[::-1, ::-1].swapaxes(2, 3))


def _backward(padding, saved, slope):
    x, kernel = saved
    to_x = _picture_slope(kernel, slope, padding)
    x = pad(x, *padding)
    if FEW[0] <= kernel.shape[3] <= FEW[1]:
        return to_x, _kernel_slope(x, kernel, slope)
    return to_x, lax.platform_dependent(
        x, kernel, slope, cpu=_kernel_slope_products, default=_kernel_slope
    )


_convolve.defvjp(_forward, _backward)

WIDE = 128
"""Channels on both sides from which fewer products pay for the sums that they take."""


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def _convolve_wide(x, kernel, padding):
    return lax.platform_dependent(pad(x, *padding), kernel, cpu=winograd.convolve, default=_valid)


def _forward_wide(x, kernel, padding):
    return _convolve_wide(x, kernel, padding), (x, kernel)


def _backward_wide(padding, saved, slope):
    def plain(x, kernel, slope):
        to_x = _picture_slope(kernel, slope, padding)
        return to_x, _kernel_slope(pad(x, *padding), kernel, slope)

    def fewer(x, kernel, slope):
        return winograd.slopes(x, kernel, slope, padding)

    return lax.platform_dependent(*saved, slope, cpu=fewer, default=plain)


_convolve_wide.defvjp(_forward_wide, _backward_wide)


def _dense(x, kernel, padding, fast: bool = False):
    side, _, ins, outs = kernel.shape
    # Sums of bfloat16 would lose what the products keep.
    fast = fast and side > 2 and min(ins, outs) >= WIDE and x.dtype == jnp.float32
    return (_convolve_wide if fast else _convolve)(x, kernel, padding)


def blocks_to_channels(x):
    """(n, 2h, 2w, c) to (n, h, w, 4c), channels in the order y, x, c."""
    n, h, w, c = x.shape
    x = x.reshape(n, h // 2, 2, w // 2, 2 * c).transpose(0, 1, 3, 2, 4)
    return x.reshape(n, h // 2, w // 2, 4 * c)


def channels_to_blocks(x):
    """Inverse of `blocks_to_channels`."""
    n, h, w, c = x.shape
    x = x.reshape(n, h, w, 2, c // 2).transpose(0, 1, 3, 2, 4)
    return x.reshape(n, 2 * h, 2 * w, c // 4)


def convolve(x, kernel, stride: int = 1, fast: bool = False):
    """Convolution that keeps the size, or halves it.

    Args:
      x: (n, h, w, i), zero outside; h and w even where stride is 2.
      kernel: (4, 4, i, o), of x's dtype.
      stride: 1 (padded by 1 before and 2 after) or 2 (by 1 on both sides).
      fast: whether a CPU may take fewer products where there are many channels (`winograd`): equal
        to 3e-6 of the result's spread, but not bit for bit between patches and the whole.

    Returns:
      (n, h / stride, w / stride, o). Differentiable by reverse mode, any number of times.

    Raises:
      ValueError: any other stride, or an odd size with stride 2.
    """
    if stride == 1:
        return _dense(x, kernel, (1, 2), fast)
    if stride != 2 or x.shape[1] % 2 or x.shape[2] % 2:
        raise ValueError(
            f"stride = {stride} on a picture of {x.shape[1:3]}: expected 1, or 2 and even sides"
        )
    ins, outs = kernel.shape[2:]
    blocks = kernel.reshape(2, 2, 2, 2 * ins, outs).transpose(0, 2, 1, 3, 4)
    return _dense(blocks_to_channels(pad(x, 1, 1)), blocks.reshape(2, 2, 4 * ins, outs), (0, 0))


def convolve_up(x, kernel, upsampling: str = "resize", fast: bool = False):
    """Convolution that doubles the size, computed on the small picture.

    The four output pixels of an input pixel are channels of one convolution of kernel 3, whose
    weights are sums of the given ones: 36 products in place of 64 for "resize".

    Args:
      x: (n, h, w, i), zero outside. kernel: (4, 4, i, o), of x's dtype.
      upsampling: "resize" repeats each pixel and convolves (Odena et al. 2016); "transposed" is the
        adjoint of `convolve` with stride 2, the kernel's last two axes swapped.
      fast: as in `convolve`.

    Returns:
      (n, 2h, 2w, o). Differentiable by reverse mode, any number of times.

    Raises:
      ValueError: another upsampling.
    """
    if upsampling not in UPSAMPLING:
        raise ValueError(f"upsampling = {upsampling!r}: expected one of {tuple(UPSAMPLING)}")
    ins, outs = kernel.shape[2:]
    sums = jnp.asarray(UPSAMPLING[upsampling], kernel.dtype)
    kernel = jnp.einsum("pak,qbl,klio->abipqo", sums, sums, kernel, precision=lax.Precision.HIGHEST)
    kernel = kernel.reshape(3, 3, ins, 4 * outs)
    return channels_to_blocks(_dense(x, kernel, (1, 1), fast))
