"""Unilateral contact with Coulomb friction: what stands on the canvas, and what slides.

The force at a contact is an unknown that is solved for together with the motion, never a
penalty on depth: the sum over the tips is what the hand feels, at any step.
"""

import jax
import jax.numpy as jnp

from jaxbrush.structs import state

TINY = 1e-12


@state
class Surface:
    """Height of what the bristles touch. height: (y, x) [mm]; pixel: () side of a pixel [mm]."""

    height: jax.Array
    pixel: jax.Array


@state
class Contact:
    """What a stamp leaves, of the k nodes that are tracked or the m that can touch, tip last.

    position: (k, 3, b) [mm] on the canvas. force: (x, y, z), each (m or k, b), of
    the canvas on the bristle [µN], mean over the stamp. reaction: (3,) of all bristles on the
    ferrule [µN].
    """

    position: jax.Array
    force: tuple
    reaction: jax.Array


def surface_height(surface: Surface | None, x, y):
    """Height under canvas points [mm], bilinear between pixel centres, edge values outside."""
    if surface is None:
        return jnp.zeros_like(x)
    rows, columns = surface.height.shape
    u = jnp.clip(x / surface.pixel - 0.5, 0.0, columns - 1.0)
    v = jnp.clip(y / surface.pixel - 0.5, 0.0, rows - 1.0)
    i = jnp.clip(jnp.floor(v).astype(int), 0, max(rows - 2, 0))
    j = jnp.clip(jnp.floor(u).astype(int), 0, max(columns - 2, 0))
    fv, fu = v - i.astype(v.dtype), u - j.astype(u.dtype)
    below, right = jnp.minimum(i + 1, rows - 1), jnp.minimum(j + 1, columns - 1)
    h = surface.height
    top = h[i, j] * (1.0 - fu) + h[i, right] * fu
    return top * (1.0 - fv) + (h[below, j] * (1.0 - fu) + h[below, right] * fu) * fv


def coulomb(compliance, free, friction, last):
    """One contact with Coulomb friction against an elastic body, solved to its slip direction.

    Finds the force F and displacement u = free + G F with u_z >= 0, F_z >= 0, u_z F_z = 0 and
    either u_t = 0 and |F_t| <= mu F_z (stick) or F_t = -mu F_z u_t / |u_t| (slip). The vertical
    is eliminated; for a given radius mu F_z the slip force minimises a quadratic on a circle,
    whose multiplier |u_t| / |F_t| is the root of a monotone equation (three Newton steps of the
    trust-region form). A radial return of the sticking force, the usual short cut, is wrong
    here: a pressed bristle is much stiffer in its own plane than across it.

    Args:
      compliance: symmetric 3 x 3 as (xx, xy, xz, yy, yz, zz), each (b,) [mm/µN].
      free: (x, y, z), each (b,): displacement from the sticking point without the force [mm].
      friction: () Coulomb coefficient.
      last: (x, y) tangential force of the stamp before, each (b,), the first guess of direction.

    Returns:
      (x, y, z) force, each (b,) [µN].
    """
    xx, xy, xz, yy, yz, zz = compliance
    sx, sy, sz = free
    touching = sz < 0.0
    # Solve a harmless problem where nothing touches: the branch not taken must not breed NaNs.
    sz = jnp.where(touching, sz, -1.0)
    inverse = 1.0 / zz
    axx, axy, ayy = xx - xz * xz * inverse, xy - xz * yz * inverse, yy - yz * yz * inverse
    bx, by = sx - xz * sz * inverse, sy - yz * sz * inverse
    det = 1.0 / jnp.maximum(axx * ayy - axy * axy, TINY * xx * yy)
    hx, hy = -(ayy * bx - axy * by) * det, -(axx * by - axy * bx) * det
    hz = -(sz + xz * hx + yz * hy) * inverse
    stick = (hx * hx + hy * hy <= (friction * hz) ** 2) & (hz > 0.0)

    drift = jnp.sqrt(bx * bx + by * by + TINY)
    held = jnp.sqrt(last[0] * last[0] + last[1] * last[1] + TINY)
    was = held > 1e-5
    tx = jnp.where(was, last[0] / held, -bx / drift)
    ty = jnp.where(was, last[1] / held, -by / drift)

    def normal(tx, ty):
        # Against a steep bristle friction can jam (denominator <= 0); then it sticks instead.
        jam = jnp.maximum(zz + friction * (xz * tx + yz * ty), 0.1 * zz)
        return -sz / jam

    radius = jnp.maximum(friction * normal(tx, ty), 1e-6)
    shift = jnp.maximum(drift / radius - (axx + ayy), 0.0)

    def newton(shift):
        d = 1.0 / ((axx + shift) * (ayy + shift) - axy * axy + TINY * xx * yy)
        fx, fy = -((ayy + shift) * bx - axy * by) * d, -((axx + shift) * by - axy * bx) * d
        square = fx * fx + fy * fy + TINY
        slope = (fx * ((ayy + shift) * fx - axy * fy) + fy * ((axx + shift) * fy - axy * fx)) * d
        slope = jnp.maximum(slope, square / (axx + ayy + shift))
        step = square / slope * (jnp.sqrt(square) / radius - 1.0)
        return jnp.maximum(shift + step, 0.0)

    for _ in range(3):
        shift = newton(shift)
    d = 1.0 / ((axx + shift) * (ayy + shift) - axy * axy + TINY * xx * yy)
    fx, fy = -((ayy + shift) * bx - axy * by) * d, -((axx + shift) * by - axy * bx) * d
    norm = jnp.sqrt(fx * fx + fy * fy + TINY)
    tx, ty = fx / norm, fy / norm
    z = normal(tx, ty)
    slip = (friction * z * tx, friction * z * ty, z)
    return tuple(
        jnp.where(touching, jnp.where(stick, h, f), 0.0)
        for h, f in zip((hx, hy, hz), slip, strict=True)
    )
