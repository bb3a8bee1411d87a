"""From height and color to a lit picture; differentiable in all of it."""

import jax
import jax.numpy as jnp

from jaxbrush.canvas import Canvas, to_srgb
from jaxbrush.structs import state


@state
class Light:
    """direction: (3,) towards the light, x right, y down, z to the viewer; any length. color: (3,).
    ambient: () share from everywhere. roughness: () of the paint's surface, GGX. gloss: () normal
    reflectance, 0.04 for oil. relief: () factor on slopes, 1 is true to scale. shadow: () strength
    of cast shadows."""

    direction: jax.Array
    color: jax.Array
    ambient: jax.Array
    roughness: jax.Array
    gloss: jax.Array
    relief: jax.Array
    shadow: jax.Array


def make_light(
    direction=(-0.55, -0.65, 0.75), color=(1.0, 0.98, 0.94), ambient=0.35, roughness=0.38,
    gloss=0.045, relief=1.0, shadow=0.6,
) -> Light:  # fmt: skip
    """Studio light from the upper left."""
    return Light(*(jnp.asarray(v, float) for v in (
        direction, color, ambient, roughness, gloss, relief, shadow)))  # fmt: skip


def _along(a, axis):
    """Central difference, one-sided at the edges."""
    n = a.shape[axis]
    if n < 2:
        return jnp.zeros_like(a)
    take = lambda lo, hi: jax.lax.slice_in_dim(a, lo, hi, axis=axis)  # noqa: E731
    inner = 0.5 * (take(2, n) - take(0, n - 2))
    return jnp.concatenate([take(1, 2) - take(0, 1), inner, take(n - 1, n) - take(n - 2, n - 1)],
                           axis=axis)  # fmt: skip


def normals(height, pixel: float, relief=1.0):
    """Unit normals (h, w, 3) of a height map (h, w) [mm], y down, z to the viewer."""
    dx = relief * _along(height, 1) / pixel
    dy = relief * _along(height, 0) / pixel
    n = jnp.stack([-dx, -dy, jnp.ones_like(dx)], axis=-1)
    return n / jnp.sqrt(jnp.sum(n * n, axis=-1, keepdims=True))


def _moved(a, dy: int, dx: int):
    """The map as seen from (dy, dx) pixels away, edge values outside."""
    h, w = a.shape
    pad = ((max(-dy, 0), max(dy, 0)), (max(-dx, 0), max(dx, 0)))
    a = jnp.pad(a, pad, mode="edge")
    return jax.lax.dynamic_slice(a, (max(dy, 0), max(dx, 0)), (h, w))


def _bilinear(a, dy, dx, reach: int):
    """The map at a traced offset of up to `reach` pixels, as a sum of hat-weighted whole moves
    along each axis."""
    for axis, d in ((0, dy), (1, dx)):
        total = 0.0
        for k in range(-reach, reach + 1):
            weight = jnp.maximum(1.0 - jnp.abs(d - k), 0.0)
            total = total + weight * (_moved(a, k, 0) if axis == 0 else _moved(a, 0, k))
        a = total
    return a


def shadows(height, pixel: float, direction, steps: int = 6):
    """Soft visibility of the light, (h, w) in (0, 1]: marches `steps` pixels towards it."""
    flat = jnp.sqrt(direction[0] ** 2 + direction[1] ** 2 + 1e-12)
    rise = direction[2] / flat * pixel
    ux, uy = direction[0] / flat, direction[1] / flat
    worst = jnp.zeros_like(height)
    for k in range(1, steps + 1):
        there = _bilinear(height, uy * k, ux * k, k)
        over = (there - height - rise * k) / (pixel * k)
        worst = jnp.maximum(worst, over)
    return 1.0 / (1.0 + 6.0 * worst)


def occlusion(height, pixel: float, radius: int = 3):
    """How open the sky is over each pixel, (h, w) in (0, 1]: mean slope up to a ring around it."""
    total = 0.0
    ring = ((0, radius), (0, -radius), (radius, 0), (-radius, 0))
    near = tuple((a // abs(a) if a else 0, b // abs(b) if b else 0) for a, b in ring)
    for distance, offsets in ((radius, ring), (1, near)):
        for dy, dx in offsets:
            slope = (_moved(height, dy, dx) - height) / (pixel * distance)
            total = total + jnp.maximum(slope, 0.0)
    return 1.0 / (1.0 + 0.15 * total)


def shade(canvas: Canvas, pixel: float, light: Light | None = None, weave=None):
    """A picture of a painted canvas under a light, (h, w, 3) linear RGB.

    Lambert and GGX (Walter et al. 2007) with Schlick's Fresnel term, soft cast shadows and
    occlusion. Differentiable in height, color and light.

    Args:
      canvas: height [mm] and color. pixel: side of a pixel [mm].
      light: see `make_light`. weave: (h, w) height of the cloth [mm], hidden by thick paint.
    """
    light = make_light() if light is None else light
    height = canvas.height
    if weave is not None:
        height = height + weave * jnp.exp(-canvas.height / 0.08)
    n = normals(height, pixel, light.relief)
    to = light.direction / jnp.sqrt(jnp.sum(light.direction**2))
    half = to + jnp.asarray([0.0, 0.0, 1.0], height.dtype)
    half = half / jnp.sqrt(jnp.sum(half**2))
    dot = lambda v: jnp.sum(n * v[None, None], axis=-1)  # noqa: E731
    nl, nh, nv = jnp.maximum(dot(to), 0.0), jnp.clip(dot(half), 0.0, 1.0), n[..., 2]
    a2 = light.roughness**4
    spread = a2 / (jnp.pi * (nh * nh * (a2 - 1.0) + 1.0) ** 2)
    k = 0.125 * (light.roughness + 1.0) ** 2
    masking = 1.0 / ((nl * (1.0 - k) + k) * (nv * (1.0 - k) + k))
    fresnel = light.gloss + (1.0 - light.gloss) * (1.0 - jnp.sum(to * half)) ** 5
    lit = 1.0 - light.shadow * (1.0 - shadows(light.relief * height, pixel, to))
    sky = occlusion(light.relief * height, pixel)
    # A flat canvas facing the viewer keeps its color.
    level = to[2] * (1.0 - light.ambient) + light.ambient
    diffuse = (light.ambient * sky + (1.0 - light.ambient) * nl * lit) / level
    # Flat paint has some gleam everywhere; only what goes beyond it brightens.
    flat_nh = half[2]
    flat = a2 / (jnp.pi * (flat_nh * flat_nh * (a2 - 1.0) + 1.0) ** 2)
    gleam = 0.25 * fresnel * (spread * masking * nl - flat * to[2]) * lit
    color = canvas.color * diffuse[..., None] + jnp.maximum(gleam, 0.0)[..., None]
    return color * light.color[None, None] / jnp.max(light.color)


def picture(linear):
    """Linear RGB to 8-bit sRGB, (h, w, 3) uint8."""
    return jnp.round(255.0 * to_srgb(linear)).astype(jnp.uint8)
