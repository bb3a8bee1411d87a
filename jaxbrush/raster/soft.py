"""Soft trajectory maps: coverage with an edge of finite width, composited in time order.

A bristle covers a pixel to the degree a, 1 inside, falling to 0 over the edge. Sweeps are laid
over each other in time order, those of a stamp by `in_stamp`, and consecutive sweeps of one
bristle count as one touch: a sweep replaces what the same bristle left at the stamp before, so the
result does not depend on how finely the stroke is sampled. With layers P (coverage, and values
times coverage) that is

  P <- keep P + add,  keep = (1 - a) / max(1 - min(a, a_before), SLACK),
                      add = a v + (1 - keep - a) v_before

(for a falling a, keep is 1: coverage stays and the value moves on). The weights in add sum to
1 - keep, so what is bare, 1 - coverage, is multiplied by keep: coverage never falls. The
backward pass runs the same sweeps in reverse from the windows that the forward pass replaced: its
cost and memory grow with the number of windows, not with the size of the image times the number
of stamps.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.raster.sweeps import FAR, Sweeps, before, exit_share, nearest
from jaxbrush.structs import state

SLACK = 1e-2
"""Bare share below which a touch counts as full: it then replaces what lies there."""


@state
class SoftMaps:
    """layers: (3 + c, h, w) coverage; force [µN], time, color times coverage. passes: (h, w).
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


def _windows(sweeps, earlier, y, x, side, radius, edge, height):
    """What sweeps (n, 1, 1) do to windows at y, x (n, 1, 1).

    Returns:
      keep (n, s, s); add (n, 4, s, s) of coverage by this sweep and, taken back, by the one before,
      of force, time; passes (n, s, s).
    """
    index = jnp.arange(side, dtype=sweeps.x.dtype)
    py, px = y + index[None, :, None], x + index[None, None, :]
    a = _coverage(sweeps, px, py, radius, edge, height)
    old = _coverage(earlier, px, py, radius, edge, height)
    there = a > 0.0
    # Nothing changes where the bristle is gone.
    keep = jnp.where(there, (1.0 - a) / jnp.maximum(1.0 - jnp.minimum(a, old), SLACK), 1.0)
    # Of the layer: by this sweep, and taken back from the one before.
    now, then = jnp.where(there, a, 0.0), jnp.where(there, 1.0 - keep - a, 0.0)
    share = exit_share(sweeps, px, py, radius)
    back = exit_share(earlier, px, py, radius)
    force = now * (sweeps.press + share * sweeps.gain)
    force = force + then * (earlier.press + back * earlier.gain)
    time = now * (sweeps.time + share * sweeps.span)
    time = time + then * (earlier.time + back * earlier.span)
    return keep, jnp.stack([now, then, force, time], axis=1), jnp.maximum(a - old, 0.0)


def in_stamp(sweeps: Sweeps):
    """Numbers of the bristles of each stamp in the order that they pass a place in, (t, b): from
    the foremost along the mean motion of those that touch to the one that trails; by number
    where they are level or at rest."""
    touch = sweeps.depth > 0.0
    total = lambda x: jnp.sum(jnp.where(touch, x, 0.0), axis=1, keepdims=True)  # noqa: E731
    ahead = sweeps.x * total(sweeps.ex) + sweeps.y * total(sweeps.ey)
    return jnp.argsort(jax.lax.stop_gradient(-ahead), axis=1, stable=True)


@jax.custom_vjp
def composite(image, keep, add, color, earlier, corner, order):
    """Lays windows over an image, one after the other: inside each, image * keep + add.

    Args:
      image: (3 + c, h, w) coverage, force, time, color. keep: (n, s, s). add: (n, 4, s, s) to
        coverage twice, force and time. color, earlier: (n, c), which come with the one and the
        other coverage. corner: (n, 2) int y, x. order: (n,) int, the number of the first window, of
        the next, ...

    Returns:
      (3 + c, h, w).
    """
    return _composite_forward(image, keep, add, color, earlier, corner, order)[0]


def _run(image, corner, order, side, change, backwards=False):
    """Applies `change(i, window)` to each window i of an image, in order.

    Returns:
      (image, (n, c, s, s) the windows as they were before their change).

    The new window is made from the stored one: with two readers of the image, XLA would copy all
    of it at every step.
    """
    count, channels = corner.shape[0], image.shape[0]
    size = (channels, side, side)

    def step(k, carry):
        image, seen = carry
        i = order[count - 1 - k if backwards else k]
        start = (jnp.zeros((), corner.dtype), corner[i, 0], corner[i, 1])
        place = (i, *3 * (jnp.zeros((), i.dtype),))
        old = jax.lax.dynamic_slice(image, start, size)
        seen = jax.lax.dynamic_update_slice(seen, old[None], place)
        old = jax.lax.dynamic_slice(seen, place, (1, *size))[0]
        return jax.lax.dynamic_update_slice(image, change(i, old), start), seen

    seen = jnp.zeros((count, *size), image.dtype)
    return jax.lax.fori_loop(0, count, step, (image, seen))


def _composite_forward(image, keep, add, color, earlier, corner, order):
    def change(i, old):
        paint = color[i][:, None, None] * add[i, :1] + earlier[i][:, None, None] * add[i, 1:2]
        new = jnp.concatenate([add[i, :1] + add[i, 1:2], add[i, 2:], paint])
        return old * keep[i][None] + new

    image, old = _run(image, corner, order, keep.shape[-1], change)
    return image, (keep, add, color, earlier, old, corner, order)


def _composite_backward(saved, slope):
    keep, add, color, earlier, old, corner, order = saved
    change = lambda i, slope: slope * keep[i][None]  # noqa: E731
    slope, by = _run(slope, corner, order, keep.shape[-1], change, backwards=True)
    by_keep = jnp.sum(by * old, axis=1)
    by_colors = [
        jnp.einsum("ncyx,nyx->nc", by[:, 3:], add[:, k], precision="highest") for k in (0, 1)
    ]
    by_cover = [
        by[:, :1] + jnp.einsum("ncyx,nc->nyx", by[:, 3:], c, precision="highest")[:, None]
        for c in (color, earlier)
    ]
    by_add = jnp.concatenate([*by_cover, by[:, 1:3]], axis=1)
    none = (np.zeros(number.shape, jax.dtypes.float0) for number in (corner, order))
    return slope, by_keep, by_add, *by_colors, *none


composite.defvjp(_composite_forward, _composite_backward)


def maps(sweeps: Sweeps, color, shape, radius, edge, height, longest) -> SoftMaps:
    """Soft maps of sweeps (t, b).

    Args:
      sweeps: from `sweeps_of` with threshold -height / 2. color: (b, c) or (t, b, c). shape: (h,
      w). radius, edge: of a bristle and its rim, longest: sweep to reach [pixels], static.
      height: over which a tip's weight rises [mm].
    """
    reach = radius + 0.5 * edge
    side = int(np.ceil(2.0 * reach + longest + 1.0))
    stamps, count = sweeps.x.shape

    def first(start, span, size):
        at = jnp.ceil(jax.lax.stop_gradient(jnp.minimum(start, start + span)) - reach)
        clipped = jnp.clip(at, -side, size)
        return clipped.astype(jnp.int32), at == clipped

    y, iny = first(sweeps.y, sweeps.ey, shape[0])
    x, inx = first(sweeps.x, sweeps.ex, shape[1])
    flat = lambda v: v.reshape(-1, *v.shape[2:])  # noqa: E731
    window = lambda tree: jax.tree.map(lambda v: v.reshape(-1, 1, 1), tree)  # noqa: E731
    # A window off the image is drawn where it does no harm, without weight.
    inside = iny & inx
    visible = lambda s: dataclasses.replace(s, depth=jnp.where(inside, s.depth, -FAR))  # noqa: E731
    keep, add, passed = _windows(
        window(visible(sweeps)),
        window(visible(before(sweeps))),
        window(y.astype(sweeps.x.dtype)),
        window(x.astype(sweeps.x.dtype)),
        side, radius, edge, height,
    )  # fmt: skip
    channels = color.shape[-1]
    colors = jnp.broadcast_to(color, (stamps, count, channels))
    earlier = jnp.concatenate([colors[:1], colors[:-1]])
    corner = flat(jnp.stack([y, x], axis=-1)) + side
    padded = (shape[0] + 2 * side, shape[1] + 2 * side)
    order = (in_stamp(sweeps) + count * jnp.arange(stamps)[:, None]).reshape(-1)
    image = jnp.zeros((3 + channels, *padded), keep.dtype)
    layers = composite(image, keep, add, flat(colors), flat(earlier), corner, order)
    numbers = jax.lax.ScatterDimensionNumbers(
        update_window_dims=(1, 2), inserted_window_dims=(), scatter_dims_to_operand_dims=(0, 1)
    )
    passes = jax.lax.scatter_add(jnp.zeros(padded, keep.dtype), corner, passed, numbers,
                                 mode=jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS)  # fmt: skip
    length = jnp.maximum(jnp.abs(sweeps.ex), jnp.abs(sweeps.ey))
    fits = (length + 2.0 * reach + 1.0 <= side) | (sweeps.depth < -0.5 * height)
    cut = lambda v: v[..., side : side + shape[0], side : side + shape[1]]  # noqa: E731
    return SoftMaps(layers=cut(layers), passes=cut(passes), whole=jnp.all(fits))
