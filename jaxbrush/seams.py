"""Where the patches of a stroke show in the picture that they make (paper Figure 9)."""

import jax
import jax.numpy as jnp

from jaxbrush import patches
from jaxbrush.patches import Layout, PatchConfig


def seam(options: PatchConfig, painted, layout: Layout, merged, mask=None):
    """How far steps from pixel to pixel of a merged picture are from what any patch says.

    A step is no seam where it lies between the steps of the patches that hold both its pixels, be
    they ever so rough; what exceeds them was made by the blend.

    Args:
      painted: (n, size, size, c), the patches. merged: (h, w, c), a picture of the whole canvas.
        mask: (h, w), of the pixels that count, or None for all.

    Returns:
      (2, h, w) from a pixel to the one below it, and to the one to its right; the largest of all
      channels, in the scale of the patches; 0 where no patch holds both.
    """
    h, w, c = merged.shape
    inside = jnp.ones((h, w), bool) if mask is None else mask > 0.0
    rows, columns = patches.pixels(layout.corner, (options.size,) * 2)
    rows, columns = jnp.broadcast_arrays(rows, columns)
    there = (rows >= 0) & (columns >= 0) & layout.present[:, None, None]
    rows, columns = jnp.where(there, rows, h), jnp.maximum(columns, 0)
    found = []
    for axis in (0, 1):
        end = [(0, 0)] * 2
        end[axis] = (0, 1)
        step = jnp.pad(jnp.diff(merged, axis=axis), [*end, (0, 0)])
        both = inside & jnp.pad(jax.lax.slice_in_dim(inside, 1, None, axis=axis), end)
        short = [slice(None)] * 3
        short[axis + 1] = slice(None, -1)
        at = (rows[tuple(short)], columns[tuple(short)])
        steps = jnp.diff(painted, axis=axis + 1)
        low = jnp.full((h, w, c), jnp.inf).at[at].min(steps, mode="drop")
        high = jnp.full((h, w, c), -jnp.inf).at[at].max(steps, mode="drop")
        beyond = jnp.maximum(jnp.maximum(step - high, low - step), 0.0)
        known = jnp.isfinite(low) & both[..., None]
        found.append(jnp.max(jnp.where(known, beyond, 0.0), axis=-1))
    return jnp.stack(found)
