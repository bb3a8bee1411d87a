"""Soft trajectory maps: coverage with an edge of finite width, composited in time order.

A bristle covers a pixel to the degree a, 1 inside, falling to 0 over the edge. Sweeps are laid
over each other in time order, and consecutive sweeps of one bristle count as one touch: a sweep
replaces what the same bristle left at the stamp before, so the result does not depend on how
finely the stroke is sampled. With layers P (coverage, and values times coverage) that is

  P <- keep P + add,  keep = (1 - a) / (1 - a_before + SLACK),  add = a v - keep a_before v_before

(for a falling a, coverage stays and the value moves on). The backward pass runs the same sweeps
in reverse from the windows that the forward pass replaced: its cost and memory grow with the
number of windows, not with the size of the image times the number of stamps.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.raster.exact import LANES
from jaxbrush.raster.sweeps import Sweeps, before, exit_share, nearest
from jaxbrush.structs import state

SLACK = 1e-2
"""Keeps the share that a bristle leaves of its own earlier touch finite."""


@state
class SoftMaps:
    """layers: (6, h, w) coverage; force [µN], time, color times coverage. passes: (h, w).
    whole: () bool."""

    layers: jax.Array
    passes: jax.Array
    whole: jax.Array


def _smoothstep(x):
    x = jnp.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def _coverage(sweep: Sweeps, x, y, radius, edge, height):
    _, square = nearest(sweep, x, y)
    touch = _smoothstep(sweep.depth / height + 0.5)
    return touch * _smoothstep((radius - jnp.sqrt(square + 1e-12)) / edge + 0.5)


def _window(sweep, earlier, color, y, x, side, radius, edge, height):
    """What one sweep does to its window: keep (s, s), add (6, s, s), passes (s, s)."""
    py = (y + jnp.arange(side, dtype=sweep.x.dtype))[:, None]
    px = (x + jnp.arange(side, dtype=sweep.x.dtype))[None, :]
    a = _coverage(sweep, px, py, radius, edge, height)
    old = _coverage(earlier, px, py, radius, edge, height)

    def carried(s):
        share = exit_share(s, px, py, radius)
        one = jnp.ones_like(share)
        values = (one, s.press + share * s.gain, s.time + share * s.span)
        return jnp.stack([*values, *(one * c for c in color)])

    now, then = carried(sweep), carried(earlier)
    most = jnp.maximum(a, old)
    keep = (1.0 - most) / (1.0 - old + SLACK)
    # Nothing changes where the bristle is gone.
    keep = jnp.where(a > 0.0, keep, 1.0)
    add = a * now + ((most - a) - keep * old) * then
    add = jnp.where(a > 0.0, add, 0.0)
    return keep, add, most - old


@jax.custom_vjp
def composite(image, keep, add, corner):
    """Lays windows over an image, one after the other: inside each, image * keep + add.

    Args:
      image: (c, h, w). keep: (n, s, s). add: (n, c, s, s). corner: (n, 2) int y, x.

    Returns:
      (c, h, w).
    """
    return _composite(image, keep, add, corner)[0]


def _composite(image, keep, add, corner):
    channels, side = image.shape[0], keep.shape[-1]

    def lay(image, inputs):
        keep, add, at = inputs
        start = (0, at[0], at[1])
        old = jax.lax.dynamic_slice(image, start, (channels, side, side))
        return jax.lax.dynamic_update_slice(image, old * keep[None] + add, start), old

    return jax.lax.scan(lay, image, (keep, add, corner))


def _composite_forward(image, keep, add, corner):
    image, old = _composite(image, keep, add, corner)
    return image, (keep, old, corner)


def _composite_backward(saved, slope):
    keep, old, corner = saved
    channels, side = slope.shape[0], keep.shape[-1]

    def lift(slope, inputs):
        keep, old, at = inputs
        start = (0, at[0], at[1])
        own = jax.lax.dynamic_slice(slope, start, (channels, side, side))
        slope = jax.lax.dynamic_update_slice(slope, own * keep[None], start)
        return slope, (jnp.sum(own * old, axis=0), own)

    slope, (by_keep, by_add) = jax.lax.scan(lift, slope, (keep, old, corner), reverse=True)
    return slope, by_keep, by_add, np.zeros(corner.shape, jax.dtypes.float0)


composite.defvjp(_composite_forward, _composite_backward)


def maps(sweeps: Sweeps, color, shape, radius, edge, height, longest) -> SoftMaps:
    """Soft maps of sweeps (t, b).

    Args:
      sweeps: from `sweeps_of` with threshold -height / 2. color: (b, 3). shape: (h, w).
      radius, edge: of a bristle and its rim, longest: sweep to reach [pixels], static.
      height: over which a tip's weight rises [mm].
    """
    reach = radius + 0.5 * edge
    side = LANES * int(np.ceil((2.0 * reach + longest + 1.0) / LANES))
    stamps, count = sweeps.x.shape
    # The previous touch can reach out of this window only where this sweep does not cover.
    earlier = before(sweeps)

    def first(start, span, size):
        at = jnp.ceil(jax.lax.stop_gradient(jnp.minimum(start, start + span)) - reach)
        clipped = jnp.clip(at, -side, size)
        return clipped.astype(jnp.int32), at == clipped

    y, iny = first(sweeps.y, sweeps.ey, shape[0])
    x, inx = first(sweeps.x, sweeps.ex, shape[1])
    colors = jnp.broadcast_to(color[None], (stamps, count, 3))

    def window(sweep, earlier, color, y, x, inside):
        parts = _window(sweep, earlier, color, y, x, side, radius, edge, height)
        keep, add, passed = parts
        return jnp.where(inside, keep, 1.0), jnp.where(inside, add, 0.0), passed * inside

    flat = lambda tree: jax.tree.map(lambda v: v.reshape(-1, *v.shape[2:]), tree)  # noqa: E731
    keep, add, passed = jax.vmap(window)(
        flat(sweeps), flat(earlier), flat(colors), flat(y), flat(x), flat(iny & inx)
    )
    corner = flat(jnp.stack([y, x], axis=-1)) + side
    padded = (shape[0] + 2 * side, shape[1] + 2 * side)
    layers = composite(jnp.zeros((6, *padded), keep.dtype), keep, add, corner)
    numbers = jax.lax.ScatterDimensionNumbers(
        update_window_dims=(1, 2), inserted_window_dims=(), scatter_dims_to_operand_dims=(0, 1)
    )
    passes = jax.lax.scatter_add(jnp.zeros(padded, keep.dtype), corner, passed, numbers,
                                 mode=jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS)  # fmt: skip
    length = jnp.maximum(jnp.abs(sweeps.ex), jnp.abs(sweeps.ey))
    fits = (length + 2.0 * reach + 1.0 <= side) | (sweeps.depth < -0.5 * height)
    cut = lambda v: v[..., side : side + shape[0], side : side + shape[1]]  # noqa: E731
    return SoftMaps(layers=cut(layers), passes=cut(passes), whole=jnp.all(fits))
