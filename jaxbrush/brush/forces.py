"""Elastic forces of the bristles: bending to a rest shape, and stretch.

A bristle is a chain of `n` segments between `n + 1` nodes; node 0 is clamped in the
ferrule. Every array is `(n, 3, b)`: segment or free node first, bristle last, because
that order makes each operation one contiguous loop over bristles.
"""

import jax.numpy as jnp
import numpy as np

from jaxbrush.brush.shapes import BrushParams


def bending_matrix(segments: int) -> np.ndarray:
    """The bending Hessian over segments, in units of EI / l0^3.

    Second differences at the inner nodes with weight 1; at the clamp the half cell and
    the mirrored ghost node give weight 2 (error 1 / (2 n^2) of the tip deflection).

    Args:
      segments: number of segments n.

    Returns:
      (n, n) symmetric tridiagonal matrix.
    """
    difference = np.eye(segments) - np.eye(segments, k=-1)
    weight = np.ones(segments)
    weight[0] = 2.0
    return difference.T @ (weight[:, None] * difference)


def differences(x):
    """`x[i] - x[i - 1]` along the first axis, with x[-1] = 0."""
    return x - jnp.concatenate([jnp.zeros_like(x[:1]), x[:-1]])


def following_sum(x):
    """`x[i] - x[i + 1]` along the first axis, with x[n] = 0: the adjoint of `differences`."""
    return x - jnp.concatenate([x[1:], jnp.zeros_like(x[:1])])


def bending_gradient(stiffness, deviation):
    """Gradient of the bending energy with respect to the segments.

    Args:
      stiffness: (b,) EI / l0^3 [g/s^2].
      deviation: (n, 3, b) segment minus rest segment [mm].

    Returns:
      (n, 3, b) [µN].
    """
    curvature = differences(deviation)
    weighted = jnp.concatenate([2.0 * curvature[:1], curvature[1:]])
    return stiffness[None, None] * following_sum(weighted)


def tension(stiffness, segment, rest_length):
    """Stretch force along each segment, `stiffness * (|e| - l0) e / |e|` [µN], (n, 3, b).

    A zero-length segment has no direction: its force and its gradient are zero.
    """
    square = jnp.sum(segment * segment, axis=1, keepdims=True)
    alive = square > 0.0
    length = jnp.sqrt(jnp.where(alive, square, 1.0))
    factor = jnp.where(alive, 1.0 - rest_length[None, None] / length, 0.0)
    return stiffness[None, None] * factor * segment


def elastic_force(params: BrushParams, segment, rest):
    """Force of bending and stretch on the free nodes 1 .. n.

    Args:
      params: brush parameters.
      segment: (n, 3, b) segment vectors [mm].
      rest: (n, 3, b) rest segment vectors in the same frame [mm].

    Returns:
      (n, 3, b) force [µN].
    """
    gradient = bending_gradient(params.bending_stiffness(segment.shape[0]), segment - rest)
    gradient = gradient + tension(
        params.stretch_stiffness(segment.shape[0]), segment, params.segment_length(segment.shape[0])
    )
    # A node is the end of its own segment and the start of the next.
    return -following_sum(gradient)


def elastic_energy(params: BrushParams, segment, rest):
    """Bending plus stretch energy of each bristle, (b,) [g mm^2/s^2]."""
    n = segment.shape[0]
    curvature = differences(segment - rest)
    square = jnp.sum(curvature * curvature, axis=1)
    bend = 0.5 * params.bending_stiffness(n) * (jnp.sum(square, axis=0) + square[0])
    norm = jnp.sqrt(jnp.sum(segment * segment, axis=1))
    stretch = (
        0.5
        * params.stretch_stiffness(n)
        * jnp.sum((norm - params.segment_length(n)[None]) ** 2, axis=0)
    )
    return bend + stretch


def node_mass(params: BrushParams, segments: int):
    """Lumped mass of the free nodes, (n, 1, b) [g]; the tip carries half a segment."""
    share = np.ones((segments, 1, 1))
    share[-1] = 0.5
    mass = params.mass * params.segment_length(segments)
    return jnp.asarray(share, params.length.dtype) * mass[None, None]


def stable_dt(params: BrushParams, segments: int):
    """Largest stable step of the explicit integrators, 2 / w_max [s].

    w_max^2 is bounded by (4 k_s + 16 k_b) / m for axial and bending chains.
    """
    mass = params.mass * params.segment_length(segments)
    square = 4.0 * params.stretch_stiffness(segments) + 16.0 * params.bending_stiffness(segments)
    return jnp.min(2.0 / jnp.sqrt(square / mass))
