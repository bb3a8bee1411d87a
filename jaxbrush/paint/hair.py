"""The bristles as the paint meets them: sample points, their volume and their motion."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.paint.state import PaintConfig, PaintParams
from jaxbrush.structs import state


@state
class Hair:
    """Points on the lowest part of the bristles in one stamp, s of each of b bristles.

    place: (3, s, b) x, y, z [mm]. motion: (3, s, b) displacement over the stamp [mm]. weight:
    (s, b) how much a point touches, 1 at the tip. share: (s, 1) of the bristle's contact. travel:
    (b,) that the tip's contact counts as [mm]. volume: (s, b) [mm^3].
    step: () travel of the brush [mm].
    """

    place: jax.Array
    motion: jax.Array
    weight: jax.Array
    share: jax.Array
    travel: jax.Array
    volume: jax.Array
    step: jax.Array


def _width(config: PaintConfig):
    """Offsets (2, m) [pixels] and weights (m,), together 1, of points across a hair that is wider
    than a pixel: a tent of that width is the sum of these tents of a pixel's."""
    n = config.across
    line = np.arange(1 - n, n)
    tent = (n - np.abs(line)) / n**2
    offset = np.stack(np.meshgrid(line, line)).reshape(2, -1)
    return offset, np.outer(tent, tent).reshape(-1)


def hair(config: PaintConfig, params: PaintParams, before, now, dt, count_share) -> Hair:
    """Sample points between two stamps, on the swept segment and not only at its end.

    Args:
      before, now: (2, 3, b) the node above the tip and the tip [mm].
      dt: () duration of the stamp [s].
      count_share: weight of each bristle (1 for a real one, 0 for padding), (b,).
    """
    share = jnp.asarray((np.arange(config.samples) + 0.5) / config.samples, now.dtype)
    along = jnp.asarray((np.arange(config.sweeps) + 0.5) / config.sweeps, now.dtype)

    def points(nodes):
        up = nodes[0] - nodes[1]
        length = jnp.sqrt(jnp.sum(up * up, axis=0) + 1e-12)
        step = jnp.minimum(params.hair_length / length, 1.0)
        return nodes[1][:, None] + up[:, None] * (share[:, None] * step[None])[None]

    a, b = points(before), points(now)
    motion = b - a
    place = a[:, None] + motion[:, None] * along[None, :, None, None]
    offset, part = _width(config)
    beside = jnp.asarray(np.pad(config.pixel * offset, ((0, 1), (0, 0))), now.dtype)
    place = place.reshape(3, 1, -1, now.shape[-1]) + beside[:, :, None, None]
    place = place.reshape(3, -1, now.shape[-1])
    motion = jnp.tile(motion, (1, config.sweeps * len(part), 1))
    moved = now[1] - before[1]
    distance = jnp.sqrt(jnp.sum(moved * moved, axis=0) + 1e-12)
    weight = jnp.tile(1.0 - 0.7 * share, config.sweeps * len(part))
    each = config.samples * config.sweeps
    part = jnp.asarray(np.repeat(part / each, each), now.dtype)[:, None]
    # The hair tapers to half its cross-section at the tip.
    taper = jnp.tile(0.5 + 0.5 * share, config.sweeps * offset.shape[1])
    volume = params.hairs * jnp.pi * params.hair_radius**2 * params.hair_length
    mean = jnp.mean(now[1] - before[1], axis=1)
    return Hair(
        place=place,
        motion=motion,
        weight=weight[:, None] * count_share[None],
        share=part,
        travel=distance + params.soak * dt,
        volume=volume * part * taper[:, None] * count_share[None],
        step=jnp.sqrt(jnp.sum(mean[:2] ** 2) + 1e-12),
    )


def corners(config: PaintConfig, place, shape):
    """The 8 cells around points and their trilinear shares.

    Args:
      place: (3, n) x, y, z in cells; cell centres at whole numbers. shape: (z, y, x).

    Returns:
      index (8, n) into the flat cells, clipped into the grid; share (8, n), 0 off the sides and
      above; what is below the canvas counts as in the first layer.
    """
    z, y, x = shape
    low = jnp.floor(place)
    part = place - low
    low = low.astype(jnp.int32)
    index, shares = [], []
    for dz in (0, 1):
        for dy in (0, 1):
            for dx in (0, 1):
                i, j, k = low[0] + dx, low[1] + dy, low[2] + dz
                share = jnp.ones_like(part[0])
                for d, p in ((dx, part[0]), (dy, part[1]), (dz, part[2])):
                    share = share * (p if d else 1.0 - p)
                inside = (i >= 0) & (i < x) & (j >= 0) & (j < y) & (k < z)
                i, j = jnp.clip(i, 0, x - 1), jnp.clip(j, 0, y - 1)
                k = jnp.clip(k, 0, z - 1)
                index.append((k * y + j) * x + i)
                shares.append(jnp.where(inside, share, 0.0))
    return jnp.stack(index), jnp.stack(shares)
