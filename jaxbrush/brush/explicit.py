"""Explicit integrators: symplectic Euler, which fails, and velocity Verlet, the reference."""

import jax
import jax.numpy as jnp

from jaxbrush.brush.contact import Contact, Surface, surface_height
from jaxbrush.brush.forces import elastic_force, node_mass
from jaxbrush.brush.handle import Pose, turned
from jaxbrush.brush.shapes import BrushConfig, BrushParams
from jaxbrush.structs import state


@state
class NodeState:
    """node: (n, 3, b) relative to the handle [mm]; velocity: (n, 3, b) relative to it [mm/s].
    rotation: (3, 3) of the handle. origin: (3,) of the handle [mm]. force: (n, 3, b) of contact
    [µN]."""

    node: jax.Array
    velocity: jax.Array
    rotation: jax.Array
    origin: jax.Array
    force: jax.Array


def init(config: BrushConfig, params: BrushParams, pose: Pose) -> NodeState:
    """Bristles at rest in the ferrule at `pose`, touching nothing."""
    rest = turned(pose.rotation, params.rest * params.segment_length(config.segments)[None, None])
    node = turned(pose.rotation, params.root)[None] + jnp.cumsum(rest, axis=0)
    zero = jnp.zeros_like(node)
    return NodeState(
        node=node, velocity=zero, rotation=pose.rotation, origin=pose.origin, force=zero
    )


def contact_of(config: BrushConfig, node, force, origin, reaction) -> Contact:
    """The tracked nodes of all-node arrays, as `Contact`."""
    m = config.tracked_nodes
    place = node[-m:] + origin[None, :, None]
    return Contact(
        position=place,
        force=tuple(force[-m:, k] for k in range(3)),
        reaction=reaction,
    )


def _touch(config, params, surface, mass, old, new, origin, velocity, dt, t):
    """Projects nodes onto the surface; the correction is the contact force times dt^2 / m.

    Returns the corrected nodes and the force [µN]."""
    height = surface_height(surface, new[:, 0] + origin[0], new[:, 1] + origin[1])
    depth = jnp.maximum(height - new[:, 2] - origin[2], 0.0)
    touching = jnp.arange(new.shape[0])[:, None] >= new.shape[0] - config.contact_nodes
    depth = jnp.where(touching, depth, 0.0)
    slide = new[:, :2] - old[:, :2] + velocity[None, :2, None] * dt
    length = jnp.sqrt(jnp.sum(slide * slide, axis=1) + 1e-30)
    # |friction| <= mu N, and N dt^2 / m is the depth.
    hold = jnp.minimum(1.0, params.friction * depth / length)
    shift = jnp.concatenate([-slide * hold[:, None], depth[:, None]], axis=1)
    return new + shift, shift * mass / dt**2


def step(
    config: BrushConfig,
    params: BrushParams,
    state: NodeState,
    pose: Pose,
    surface: Surface | None = None,
):
    """Advances to `pose` by `config.substeps` steps; stable while each is below `stable_dt`.

    The handle moves on a straight line at constant velocity and its rotation is interpolated.
    Contact is inelastic. Order 1 (symplectic Euler) or 2 (Verlet) in the free motion.
    """
    n = config.segments
    verlet = config.integrator == "verlet"
    mass = node_mass(params, n)
    dt = pose.dt / config.substeps
    length = params.segment_length(n)[None, None]
    base_0, base_1 = turned(state.rotation, params.root), turned(pose.rotation, params.root)
    rest_0, rest_1 = (turned(r, params.rest * length) for r in (state.rotation, pose.rotation))

    def elastic(node, t):
        base = base_0 + (base_1 - base_0) * t
        segment = jnp.concatenate([node[:1] - base[None], node[1:] - node[:-1]])
        return elastic_force(params, segment, rest_0 + (rest_1 - rest_0) * t)

    decay = jnp.exp(-params.damping * dt * (0.5 if verlet else 1.0))
    # Damping takes this share of the impulse that a resting node is pushed back by.
    kept = 0.5 * (1.0 + decay * decay) if verlet else decay

    def substep(carry, index):
        node, velocity, force, total, reaction = carry
        t = (index + 1) / config.substeps
        if verlet:
            half = decay * velocity + 0.5 * dt * force / mass
        else:
            half = decay * (velocity + dt * force / mass)
        origin = state.origin + (pose.origin - state.origin) * t
        free = node + dt * half
        moved, push = _touch(
            config, params, surface, mass, node, free, origin, pose.velocity, dt, t
        )
        half = half + (moved - free) / dt
        force = elastic(moved, t)
        velocity = decay * (half + 0.5 * dt * force / mass) if verlet else half
        reaction = reaction - jnp.sum(force, axis=(0, 2)) / config.substeps
        return (moved, velocity, force, total + push / (kept * config.substeps), reaction), None

    velocity = state.velocity - pose.jump[None, :, None]
    start = (
        state.node,
        velocity,
        elastic(state.node, 0.0),
        jnp.zeros_like(state.node),
        jnp.zeros(3, state.node.dtype),
    )
    (node, velocity, _, force, reaction), _ = jax.lax.scan(
        substep, start, jnp.arange(config.substeps, dtype=state.node.dtype)
    )
    contact = contact_of(config, node, force, pose.origin, reaction)
    return NodeState(
        node=node, velocity=velocity, rotation=pose.rotation, origin=pose.origin, force=force
    ), contact
