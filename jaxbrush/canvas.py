"""The painted canvas as two maps, and how pigment amounts become the color that is seen."""

import jax
import jax.numpy as jnp

from jaxbrush.structs import state

LINEN = (0.80, 0.76, 0.68)
"""Default ground, linear RGB: primed canvas."""
OPACITY = 0.03
"""Default film thickness that hides 63 % of what is under it [mm]."""


@state
class Canvas:
    """height: (h, w) thickness of the paint [mm]. color: (h, w, 3) of what is seen, linear RGB."""

    height: jax.Array
    color: jax.Array


def blank(shape, color=LINEN) -> Canvas:
    """A bare canvas of `shape` (h, w)."""
    color = jnp.broadcast_to(jnp.asarray(color, float), (*shape, 3))
    return Canvas(height=jnp.zeros(shape, float), color=color)


def composite(canvas: Canvas, patch: Canvas, mask, corner) -> Canvas:
    """Lays a patch over a canvas where a mask says so.

    Args:
      canvas: (h, w). patch: (p, q). mask: (p, q) in [0, 1], 1 takes the patch.
      corner: (2,) int y, x of the patch; it must lie inside the canvas.

    Returns:
      Canvas.

    Raises:
      ValueError: a mask that does not fit the patch, or a patch larger than the canvas.
    """
    p, q = patch.height.shape
    h, w = canvas.height.shape
    if mask.shape != (p, q) or p > h or q > w:
        raise ValueError(
            f"mask {mask.shape}, patch {(p, q)}, canvas {(h, w)}: expected a mask of the patch's "
            "shape, and a patch no larger than the canvas"
        )
    # Clipped here: XLA's own clamping is wrong in some releases.
    y, x = jnp.clip(corner[0], 0, h - p), jnp.clip(corner[1], 0, w - q)
    height = jax.lax.dynamic_slice(canvas.height, (y, x), (p, q))
    color = jax.lax.dynamic_slice(canvas.color, (y, x, 0), (p, q, 3))
    height = height + mask * (patch.height - height)
    color = color + mask[..., None] * (patch.color - color)
    return Canvas(
        height=jax.lax.dynamic_update_slice(canvas.height, height, (y, x)),
        color=jax.lax.dynamic_update_slice(canvas.color, color, (y, x, 0)),
    )


def _power(base, exponent: float):
    """Of a positive base: a third of the time that XLA's CPU backend takes for `**`."""
    return jnp.exp(exponent * jnp.log(base))


def mix_linear(shares, palette):
    """Mean of the pigments' colors, as lights mix: (..., k) shares, (k, 3) palette to (..., 3)."""
    return jnp.matmul(shares, palette, precision=jax.lax.Precision.HIGHEST)


def absorbed(color, exponent: float = 0.35):
    """Linear RGB to a power of absorption over scattering (Kubelka, Munk 1931: K/S of an opaque
    layer is (1 - R)^2 / 2R), channel by channel: where paints mix, this is their mean.

    Exponent 1 is Kubelka-Munk with one constant, which lets a trace of a dark pigment take over;
    a smaller exponent is closer to what paint from tubes does.
    """
    reflectance = jnp.clip(color, 1e-3, 0.999)
    return _power(jnp.square(1.0 - reflectance) / (2.0 * reflectance), exponent)


def reflected(mean, exponent: float = 0.35):
    """Inverse of `absorbed`, on [1e-3, 0.999]."""
    # A pixel without paint has no ratio; the bound keeps its slope finite.
    mixed = _power(jnp.maximum(mean, 1e-8), 1.0 / exponent)
    # As a quotient: the difference of the same terms cancels where it is dark.
    return 1.0 / (1.0 + mixed + jnp.sqrt(mixed * mixed + 2.0 * mixed))


def mix_subtractive(shares, palette, exponent: float = 0.35):
    """Mixture of pigments by the mean of what `absorbed` makes of them."""
    mean = absorbed(palette, exponent)
    mean = jnp.matmul(shares, mean, precision=jax.lax.Precision.HIGHEST)
    return reflected(mean, exponent)


MIXING = {"linear": mix_linear, "subtractive": mix_subtractive}


def flatten(paint, layer, palette, opacity=OPACITY, ground=LINEN, mixing: str = "linear") -> Canvas:
    """What is seen of a paint volume from above.

    Light is absorbed in paint by Beer and Lambert's law: a film of thickness s hides the share
    1 - exp(-s / opacity) of what lies under it. The pigments of a column count by the share of the
    light that they return.

    Args:
      paint: (z, k, y, x) pigment amounts, shares of a cell. layer: height of a cell [mm].
      palette: (k, 3) linear RGB of the pigments. opacity: [mm]. ground: (3,) or (y, x, 3).
      mixing: "linear" or "subtractive".

    Returns:
      Canvas (y, x).

    Raises:
      ValueError: an unknown mixing.
    """
    if mixing not in MIXING:
        raise ValueError(f"mixing = {mixing!r}: expected one of {tuple(MIXING)}")
    fill = jnp.sum(paint, axis=1) * (layer / opacity)
    above = jnp.flip(jnp.cumsum(jnp.flip(fill, 0), axis=0), 0)
    seen = jnp.exp(-(above - fill)) - jnp.exp(-above)
    share = paint * (layer / opacity) / jnp.maximum(fill, 1e-12)[:, None]
    amount = jnp.moveaxis(jnp.sum(share * seen[:, None], axis=0), 0, -1)
    total = jnp.sum(amount, axis=-1, keepdims=True)
    color = MIXING[mixing](amount / jnp.maximum(total, 1e-12), jnp.asarray(palette, paint.dtype))
    bare = jnp.exp(-above[0])[..., None]
    ground = jnp.broadcast_to(jnp.asarray(ground, paint.dtype), color.shape)
    return Canvas(
        height=layer * jnp.sum(paint, axis=(0, 1)), color=color * (1.0 - bare) + ground * bare
    )


def to_srgb(linear):
    """Linear RGB in [0, 1] to sRGB (IEC 61966-2-1), differentiable at 0."""
    x = jnp.clip(linear, 0.0, 1.0)
    high = 1.055 * _power(jnp.maximum(x, 0.0031308), 1.0 / 2.4) - 0.055
    return jnp.where(x <= 0.0031308, 12.92 * x, high)


def from_srgb(srgb):
    """sRGB in [0, 1] to linear RGB."""
    x = jnp.clip(srgb, 0.0, 1.0)
    return jnp.where(x <= 0.04045, x / 12.92, _power((x + 0.055) / 1.055, 2.4))
