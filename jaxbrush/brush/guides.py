"""Guide bristles: simulate a few, let the rest follow. The level of detail of a brush."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.brush.contact import Surface, surface_height
from jaxbrush.brush.handle import turned
from jaxbrush.brush.shapes import BrushConfig, BrushParams

NEAREST = 3


def choose(params: BrushParams, count: int) -> np.ndarray:
    """Indices of `count` guides, evenly spaced in the order of the bristles.

    `make_brush` fills its ferrule by low-discrepancy sequences, of which every such subset
    covers the ferrule again; traced roots are not looked at, so the choice is static.
    """
    return (np.arange(count) * params.length.shape[0]) // count


def take(params: BrushParams, index: np.ndarray) -> BrushParams:
    """The brush made of the bristles `index`, which carry the press force of all."""
    b = params.length.shape[0]
    chosen = {
        name: getattr(params, name)[..., index]
        for name in ("root", "rest", "length", "bending", "stretch", "mass")
    }
    return dataclasses.replace(params, **chosen, press_force=params.press_force * (len(index) / b))


def weights(params: BrushParams, index: np.ndarray):
    """Shares of each guide in each bristle, (g, b): inverse square distance of the clamp points
    to the nearest three; a guide follows itself only."""
    root = params.root[:2]
    offset = root[:, index][:, :, None] - root[:, None, :]
    square = jnp.sum(offset * offset, axis=0)
    near, which = jax.lax.top_k(-square.T, min(NEAREST, len(index)))
    share = 1.0 / (1e-6 - near)
    share = share / jnp.sum(share, axis=1, keepdims=True)
    hot = (which[:, :, None] == jnp.arange(len(index), dtype=which.dtype)[None, None]).astype(
        root.dtype
    )
    return jnp.sum(hot * share[:, :, None], axis=1).T


def _rest_nodes(config, params, rotation):
    """Tracked nodes of the undeformed brush relative to the handle, (t, m, 3, b)."""
    segment = params.rest * params.segment_length(config.segments)[None, None]
    node = params.root[None] + jnp.cumsum(segment, axis=0)[-config.tracked_nodes :]
    return jax.vmap(lambda r: turned(r, node))(rotation)


def follow(
    config: BrushConfig, params: BrushParams, rotation, track, index, surface: Surface | None
):
    """Extends the track of the guides to all bristles.

    A bristle takes the weighted displacement of its guides from rest, and their force; it stays
    above the canvas. Its own length and curl enter through its rest shape.
    """
    share = weights(params, index)
    own = _rest_nodes(config, params, rotation)
    guide = own[..., index]
    spread = lambda x: jnp.matmul(x, share, precision=jax.lax.Precision.HIGHEST)  # noqa: E731
    position = own + spread(track.position - guide)
    floor = surface_height(surface, position[:, :, 0], position[:, :, 1])
    height = jnp.maximum(position[:, :, 2], floor)
    position = jnp.concatenate([position[:, :, :2], height[:, :, None]], axis=2)
    return dataclasses.replace(
        track,
        position=position,
        force=spread(track.force),
        reaction=track.reaction * (params.length.shape[0] / len(index)),
    )
