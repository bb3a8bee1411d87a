"""Implicit Euler by Newton's method with a direct banded solve: the accurate integrator.

Bending couples a node to two neighbours on each side, so the matrix of a bristle is block
pentadiagonal with 3 x 3 blocks; one block LDL^T sweep down the bristle and one up solve it for
all bristles at once.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.brush import explicit
from jaxbrush.brush.contact import Surface, surface_height
from jaxbrush.brush.explicit import NodeState, contact_of
from jaxbrush.brush.forces import bending_matrix, elastic_force, node_mass
from jaxbrush.brush.handle import Pose, turned
from jaxbrush.brush.shapes import BrushConfig, BrushParams

RIGID = 1e9
"""Stiffness that holds a touching node on the surface [g/s^2]: 1e4 times a bristle's own."""
STICK = 1e-6
"""Displacement in a stamp up to which friction holds elastically [mm]."""

init = explicit.init


def _product(a, b):
    return a[:, 0, None] * b[:1] + a[:, 1, None] * b[1:2] + a[:, 2, None] * b[2:]


def _apply(a, x):
    return a[:, 0] * x[:1] + a[:, 1] * x[1:2] + a[:, 2] * x[2:]


def _transpose(a):
    return jnp.swapaxes(a, 0, 1)


def _inverse(a):
    """Inverse of symmetric positive definite (3, 3, b) by cofactors."""
    rows = [jnp.cross(a[i], a[j], axis=0) for i, j in ((1, 2), (2, 0), (0, 1))]
    det = jnp.sum(a[0] * rows[0], axis=0)
    return jnp.stack(rows, axis=1) / det[None, None]


def solve_pentadiagonal(diagonal, lower, lower2, rhs):
    """Solves the block pentadiagonal systems of all bristles.

    Args:
      diagonal: (n, 3, 3, b), symmetric. lower: (n, 3, 3, b) block (i, i - 1), the first ignored.
      lower2: (n, b) block (i, i - 2) as a multiple of the identity, the first two ignored.
      rhs: (n, 3, b).

    Returns:
      (n, 3, b). The matrix must be positive definite.
    """
    b = rhs.shape[-1]
    zero, flat = jnp.zeros((3, 3, b), rhs.dtype), jnp.zeros((3, b), rhs.dtype)
    inside = jnp.asarray((np.arange(rhs.shape[0]) >= 1)[:, None, None, None], rhs.dtype)
    inside2 = jnp.asarray((np.arange(rhs.shape[0]) >= 2)[:, None], rhs.dtype)

    def down(carry, inputs):
        inverse_2, inverse_1, multiplier_1, y_2, y_1 = carry
        a0, a1, a2, r = inputs
        a2 = a2[None, None]
        m2 = a2 * inverse_2
        s1 = a1 - a2 * _transpose(multiplier_1)
        m1 = _product(s1, inverse_1)
        pivot = a0 - a2 * m2 - _product(s1, _transpose(m1))
        y = r - _apply(m1, y_1) - _apply(m2, y_2)
        inverse = _inverse(pivot)
        return (inverse_1, inverse, m1, y_1, y), (inverse, m1, m2, y)

    start = (zero, zero, zero, flat, flat)
    _, (inverse, m1, m2, y) = jax.lax.scan(
        down, start, (diagonal, lower * inside, lower2 * inside2, rhs)
    )

    def up(carry, inputs):
        x_2, x_1, m1_1, m2_2, m2_1 = carry
        inverse, m1, m2, y = inputs
        x = _apply(inverse, y) - _apply(_transpose(m1_1), x_1) - _apply(_transpose(m2_2), x_2)
        return (x_1, x, m1, m2_1, m2), x

    _, x = jax.lax.scan(up, (flat, flat, zero, zero, zero), (inverse, m1, m2, y), reverse=True)
    return x


def _stretch_blocks(stiffness, segment, length):
    """Positive semidefinite Hessian of the stretch energy by segment, (n, 3, 3, b)."""
    norm = jnp.sqrt(jnp.sum(segment * segment, axis=1, keepdims=True) + 1e-20)
    d = segment / norm
    across = jnp.maximum(1.0 - length[None, None] / norm, 0.0)[:, :, None]
    eye = jnp.eye(3, dtype=segment.dtype)[None, :, :, None]
    both = d[:, :, None] * d[:, None]
    return stiffness[None, None, None] * (both + across * (eye - both))


def step(
    config: BrushConfig,
    params: BrushParams,
    state: NodeState,
    pose: Pose,
    surface: Surface | None = None,
):
    """Advances to `pose` by one implicit Euler step, `config.iterations` Newton iterations.

    Contact by an active set (a node presses while its force is positive, and is then held on
    the surface); friction by iteratively reweighted springs to where the node was.
    """
    n, m = config.segments, config.contact_nodes
    mass, length = node_mass(params, n), params.segment_length(n)
    dtype = mass.dtype
    dt = pose.dt
    base, rest = (
        turned(pose.rotation, params.root),
        turned(pose.rotation, params.rest * length[None, None]),
    )
    flight = state.node + dt * (state.velocity - pose.jump[None, :, None])
    inertia = mass / dt**2
    drag = params.damping * mass / dt
    bend = params.bending_stiffness(n)
    difference = np.eye(n) - np.eye(n, k=-1)
    nodes = difference.T @ bending_matrix(n) @ difference
    eye = jnp.eye(3, dtype=dtype)[None, :, :, None]
    can_touch = jnp.asarray((np.arange(n) >= n - m)[:, None])
    stretch = params.stretch_stiffness(n)

    def band(k):
        entries = np.concatenate([np.zeros(k), np.diag(nodes, -k)])
        return jnp.asarray(entries[:, None], dtype) * bend[None]

    def newton(carry, _):
        node, normal, slip = carry
        segment = jnp.concatenate([node[:1] - base[None], node[1:] - node[:-1]])
        force = elastic_force(params, segment, rest)
        force = force - inertia * (node - flight) - drag * (node - state.node)
        blocks = _stretch_blocks(stretch, segment, length)
        above = jnp.concatenate([blocks[1:], jnp.zeros_like(blocks[:1])])
        diagonal = (band(0)[:, None] + inertia + drag)[:, :, None] * eye + blocks + above
        lower = band(1)[:, None, None] * eye - blocks

        floor = surface_height(surface, node[:, 0] + pose.origin[0], node[:, 1] + pose.origin[1])
        gap = node[:, 2] + pose.origin[2] - floor
        active = can_touch & ((normal > 0.0) | (gap < 0.0))
        hold = jnp.where(active, RIGID, 0.0)
        moved = node[:, :2] - state.node[:, :2] + (pose.velocity[:2] * dt)[None, :, None]
        grip = jnp.where(active, params.friction * jnp.maximum(normal, 0.0) / slip, 0.0)
        spring = jnp.stack([grip, grip, hold], axis=1)
        pull = jnp.concatenate([moved, gap[:, None]], axis=1)
        diagonal = diagonal + spring[:, :, None] * eye
        change = solve_pentadiagonal(diagonal, lower, band(2), force - spring * pull)
        # A change of direction beyond about half a radian is outside the quadratic model.
        bent = jnp.concatenate([change[:1], change[1:] - change[:-1]])
        worst = jnp.max(jnp.sqrt(jnp.sum(bent * bent, axis=1) + 1e-30) / length[None], axis=0)
        change = change * jnp.minimum(1.0, 0.5 / worst)[None, None]
        push = -spring * (pull + change)
        node = node + change
        normal = jnp.where(active, push[:, 2], 0.0)
        moved = moved + change[:, :2]
        slip = jnp.sqrt(jnp.sum(moved * moved, axis=1) + STICK**2)
        return (node, normal, slip), push

    # Slip starts from how fast the node slid: only that lets a bristle slide under a still handle.
    slide = (flight - state.node)[:, :2] + (pose.velocity[:2] * dt)[None, :, None]
    start = (state.node, state.force[:, 2], jnp.sqrt(jnp.sum(slide * slide, axis=1) + STICK**2))
    (node, _, _), push = jax.lax.scan(newton, start, None, length=config.iterations)
    force = jnp.where((push[-1][:, 2:] > 0.0), push[-1], 0.0)
    velocity = (node - state.node) / dt
    segment = jnp.concatenate([node[:1] - base[None], node[1:] - node[:-1]])
    reaction = -jnp.sum(elastic_force(params, segment, rest), axis=(0, 2))
    following = NodeState(
        node=node, velocity=velocity, rotation=pose.rotation, origin=pose.origin, force=force
    )
    return following, contact_of(config, node, force, pose.origin, reaction)
