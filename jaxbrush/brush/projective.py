"""Projective dynamics with one shared inverse: the fast integrators.

Unknowns are the segments, unit vectors times l0, so length is exact. In segment space the
bending Hessian is one constant tridiagonal matrix, the same for all bristles up to a factor;
its inverse factor Q (H^-1 = Q^T Q) is shared. One iteration projects the residual force on the
tangents of the unit spheres, whitens it and the directions of the contact with Q, solves the
3 x 3 contact problem with friction in that metric, and turns the segments. `quasi_static`
leaves out inertia (Q is a constant of the node count); `projective` has implicit Euler's.

Everything is a tuple (x, y, z) of (n, b) arrays: XLA's CPU back end vectorises those, and not
the reshapes that a packed (n, 3, b) array needs before a matrix product.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.brush.contact import Contact, Surface, coulomb, surface_height
from jaxbrush.brush.forces import bending_matrix
from jaxbrush.brush.handle import Pose
from jaxbrush.brush.shapes import BrushConfig, BrushParams
from jaxbrush.structs import state

Vec = tuple[jax.Array, jax.Array, jax.Array]


@state
class ProjectiveState:
    """segment: Vec of (n, b) [mm]. force: for x, y, z a list of m (b,) [µN]. point: the same,
    where the contact nodes were [mm]. node: Vec of (n, b) relative to the handle [mm] and
    velocity: Vec of (n, b) [mm/s], empty when quasi-static. depth: () extra lowering [mm] of
    force mode."""

    segment: Vec
    force: list
    point: list
    node: Vec | tuple
    velocity: Vec | tuple
    depth: jax.Array


def _dot(matrix, x):
    return jnp.dot(jnp.asarray(matrix, x.dtype), x, precision=jax.lax.Precision.HIGHEST)


def _inner(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _column_sum(x):
    # As a product with ones: XLA's CPU reduction over the first axis is several times slower.
    return _dot(np.ones((1, x.shape[0])), x)[0]


def _turned(rotation, v) -> Vec:
    return tuple(
        rotation[k, 0] * v[0] + rotation[k, 1] * v[1] + rotation[k, 2] * v[2] for k in range(3)
    )


def _reaches(segments: int, nodes: int) -> np.ndarray:
    """(n, m): 1 where segment i lies between the ferrule and contact node c."""
    return (np.arange(segments)[:, None] <= np.arange(segments - nodes, segments)).astype(float)


def inertia_matrix(segments: int) -> np.ndarray:
    """(n, n) kinetic form over segments, in units of the node mass: C^T M C, C the running sum."""
    running = np.tril(np.ones((segments, segments)))
    mass = np.ones(segments)
    mass[-1] = 0.5
    return running.T @ (mass[:, None] * running)


def inverse_factor(segments: int) -> np.ndarray:
    """Q with Q^T Q the inverse of `bending_matrix`, (n, n)."""
    return np.linalg.inv(np.linalg.cholesky(bending_matrix(segments)))


def dynamic_inverse_factor(config: BrushConfig, params: BrushParams, dt):
    """Q of bending plus inertia at step dt, of the mean bristle, (n, n)."""
    n = config.segments
    mass = params.mass * params.segment_length(n)
    ratio = jnp.mean(mass / params.bending_stiffness(n)) * (1.0 / dt + params.damping) / dt
    dtype = params.length.dtype
    matrix = jnp.asarray(bending_matrix(n), dtype) + ratio * jnp.asarray(inertia_matrix(n), dtype)
    return jnp.linalg.inv(jnp.linalg.cholesky(matrix))


def init(config: BrushConfig, params: BrushParams, pose: Pose) -> ProjectiveState:
    """Bristles at rest in the ferrule at `pose`, touching nothing."""
    n, m = config.segments, config.contact_nodes
    length = params.segment_length(n)
    segment = _turned(pose.rotation, tuple(params.rest[:, k] * length for k in range(3)))
    base = _turned(pose.rotation, params.root)
    zero = jnp.zeros(params.length.shape, params.length.dtype)
    reach = _reaches(n, m).T
    point = []
    for k in range(3):
        node = _dot(reach, segment[k])
        point.append([node[c] + base[k] + pose.origin[k] for c in range(m)])
    node, velocity = (), ()
    if config.integrator == "projective":
        running = np.tril(np.ones((n, n)))
        node = tuple(_dot(running, segment[k]) + base[k] for k in range(3))
        velocity = tuple(jnp.zeros_like(x) for x in node)
    return ProjectiveState(
        segment=segment,
        force=[[zero] * m] * 3,
        point=point,
        node=node,
        velocity=velocity,
        depth=jnp.zeros((), params.length.dtype),
    )


def _worst_contact(gap, normal):
    """Share (1 or 0) of each contact node in this iteration, a list of m (b,): the node that
    breaks its condition most, the tip on a draw."""
    broken = [
        jnp.where(f > 0.0, jnp.abs(g), jnp.maximum(-g, 0.0)) + 1e-9 * c
        for c, (g, f) in enumerate(zip(gap, normal, strict=True))
    ]
    top = broken[0]
    for x in broken[1:]:
        top = jnp.maximum(top, x)
    hit = [(x >= top).astype(top.dtype) for x in broken]
    total = sum(hit)
    return [x / total for x in hit]


def _lowering(compliance_z, free_z, target, others):
    """Extra depth at which the frictionless normal forces sum to `target`: Newton on a convex
    piecewise linear function, () [mm]."""
    depth = jnp.zeros((), free_z.dtype)
    stiffness = 1.0 / compliance_z
    for _ in range(4):
        pressed = depth - free_z > 0.0
        total = jnp.sum(jnp.where(pressed, (depth - free_z) * stiffness, 0.0)) + others
        slope = jnp.maximum(jnp.sum(jnp.where(pressed, stiffness, 0.0)), jnp.mean(stiffness))
        depth = depth + (target - total) / slope
    return depth


def step(
    config: BrushConfig,
    params: BrushParams,
    state: ProjectiveState,
    pose: Pose,
    factor,
    target=None,
    surface: Surface | None = None,
):
    """Advances the bristles to `pose` by `config.iterations` iterations.

    Args:
      config: static counts. params: brush. state: bristles at the stamp before.
      pose: ferrule at the end of the stamp.
      factor: (n, n) Q, from `inverse_factor` or `dynamic_inverse_factor`.
      target: () total normal force [µN] the handle is lowered to reach, or None.
      surface: height of what is touched, or None for the plane z = 0.

    Returns:
      (state, Contact).
    """
    n, m = config.segments, config.contact_nodes
    dtype = params.length.dtype
    reach = _reaches(n, m)
    length = params.segment_length(n)
    stiffness = params.bending_stiffness(n)
    soft = n / params.stretch_stiffness(n)
    by_length, by_stiffness = 1.0 / length, 1.0 / stiffness
    bending = bending_matrix(n)
    dynamic = config.integrator == "projective"

    rest = _turned(pose.rotation, tuple(params.rest[:, k] * length for k in range(3)))
    base = _turned(pose.rotation, params.root)
    base = tuple(base[k] + pose.origin[k] for k in range(3))
    e, force, depth = state.segment, state.force, state.depth
    if dynamic:
        running = np.tril(np.ones((n, n)))
        share = jnp.asarray(np.append(np.ones(n - 1), 0.5)[:, None], dtype)
        mass = share * params.mass * length
        # Free flight in the handle's frame; its acceleration enters as the jump of velocity.
        flight = tuple(
            state.node[k] + pose.dt * (state.velocity[k] - pose.jump[k]) for k in range(3)
        )

    def places(e, depth):
        """Contact nodes on the canvas, a Vec of lists of m (b,)."""
        out = []
        for k in range(3):
            node = _dot(reach.T, e[k])
            out.append([node[c] + (base[2] - depth if k == 2 else base[k]) for c in range(m)])
        return out

    def spread(rows):
        """Force on the contact nodes, m of (b,), to the segments they pull on, (n, b)."""
        return sum(jnp.asarray(reach[:, c : c + 1], dtype) * rows[c] for c in range(m))

    for _ in range(config.iterations):
        place = places(e, depth)
        gap = [place[2][c] - surface_height(surface, place[0][c], place[1][c]) for c in range(m)]
        d = tuple(x * by_length for x in e)
        f = tuple(spread(force[k]) - stiffness * _dot(bending, e[k] - rest[k]) for k in range(3))
        if dynamic:
            node = tuple(_dot(running, e[k]) + base[k] - pose.origin[k] for k in range(3))
            pull = tuple(
                mass
                / pose.dt
                * ((node[k] - flight[k]) / pose.dt + params.damping * (node[k] - state.node[k]))
                for k in range(3)
            )
            f = tuple(f[k] - _dot(running.T, pull[k]) for k in range(3))
        axial = _inner(d, f)
        whitened = tuple(_dot(factor, f[k] - d[k] * axial) for k in range(3))

        chosen = _worst_contact(gap, force[2])
        inside = spread(chosen)

        def pick(rows, chosen=chosen):
            return sum(rows[c] * chosen[c] for c in range(m))

        fx, fy, fz = (pick(force[k]) for k in range(3))
        # Columns of the tangent projector, Pi = 1 - d d^T, of the segments above the contact.
        column = {}
        for a in range(3):
            for k in range(a, 3):
                entry = (1.0 - d[a] * d[a] if a == k else -d[a] * d[k]) * inside
                column[a, k] = column[k, a] = _dot(factor, entry)
        arm = [tuple(column[a, k] for k in range(3)) for a in range(3)]
        moved = [_column_sum(_inner(arm[a], whitened)) * by_stiffness for a in range(3)]
        bend = [
            _column_sum(_inner(arm[a], arm[c])) * by_stiffness
            for a in range(3)
            for c in range(a, 3)
        ]
        xx, xy, xz, yy, yz, zz = bend
        away = [pick([place[k][c] - state.point[k][c] for c in range(m)]) for k in range(2)]
        free = (
            away[0] + moved[0] - xx * fx - xy * fy - xz * fz,
            away[1] + moved[1] - xy * fx - yy * fy - yz * fz,
            pick(gap) + moved[2] - xz * fx - yz * fy - zz * fz,
        )
        compliance = (xx + soft, xy, xz, yy + soft, yz, zz + soft)
        if target is not None:
            others = sum(jnp.sum(row) for row in force[2]) - jnp.sum(fz)
            lower = _lowering(compliance[5], free[2], target, others)
            depth = depth + lower
            free = (free[0], free[1], free[2] - lower)
        new = coulomb(compliance, free, params.friction, (fx, fy))
        # XLA's CPU back end stores the result of a division and recomputes all cheaper
        # operations for every segment that reads them: dividing last makes it solve once.
        kick = [
            [(x - old) * share * by_length / by_length for share in chosen]
            for x, old in zip(new, (fx, fy, fz), strict=True)
        ]
        force = [[force[k][c] + kick[k][c] for c in range(m)] for k in range(3)]
        f = tuple(f[k] + spread(kick[k]) for k in range(3))
        axial = _inner(d, f)
        turned = tuple(
            _dot(factor.T, _dot(factor, f[k] - d[k] * axial)) * by_stiffness for k in range(3)
        )
        along = _inner(d, turned)
        e = tuple(e[k] + turned[k] - d[k] * along for k in range(3))
        scale = length * jax.lax.rsqrt(_inner(e, e) + TINY_SQUARE)
        e = tuple(x * scale for x in e)

    place = places(e, depth)
    node, velocity = (), ()
    if dynamic:
        node = tuple(_dot(running, e[k]) + base[k] - pose.origin[k] for k in range(3))
        velocity = tuple((node[k] - state.node[k]) / pose.dt for k in range(3))
    next_state = ProjectiveState(
        segment=e, force=force, point=place, node=node, velocity=velocity, depth=depth
    )
    root = tuple(
        stiffness * (3.0 * (e[k][0] - rest[k][0]) - (e[k][1] - rest[k][1])) for k in range(3)
    )
    first = tuple(e[k][0] * by_length for k in range(3))
    load = tuple(sum(force[k][c] for c in range(m)) for k in range(3))
    if dynamic:
        load = tuple(load[k] - jnp.sum(pull[k], axis=0) for k in range(3))
    tension = _inner(first, tuple(load[k] - root[k] for k in range(3)))
    reaction = jnp.stack([jnp.sum(root[k] + first[k] * tension) for k in range(3)])
    contact = Contact(
        position=tuple(jnp.stack(x) for x in place),
        force=tuple(jnp.stack(x) for x in force),
        reaction=reaction,
    )
    return next_state, contact


TINY_SQUARE = 1e-20
"""[mm^2] keeps the gradient of a segment's direction finite when it has no length."""
