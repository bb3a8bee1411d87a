"""Projective dynamics with one shared inverse: the fast integrators.

Unknowns are the segments, unit vectors times l0, so length is exact. Over segments the bending
Hessian is one constant tridiagonal matrix, the same for all bristles up to a factor, and stays
nearly so in tangent frames that turn little from segment to segment; its inverse P = Q^T Q is
shared. One iteration projects the residual force on the tangents, whitens it and the directions
of the contact with Q, solves the 3 x 3 contact problem with friction in that metric, and turns
the segments. Only the geometric stiffness of the axial load is left out of the matrix; the
fixed point is exact. `quasi_static` leaves out inertia (Q depends on the node count alone);
`projective` has implicit Euler's.

Layout and grouping follow XLA's CPU back end: (component, n, b) makes every matrix product one
batched call and every other operation one vector loop, contact arithmetic is on (b,) rows, and
what many segments read is stored by ending in a division (cheaper producers are recomputed).
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.brush.contact import Contact, Surface, coulomb, surface_height
from jaxbrush.brush.forces import bending_matrix
from jaxbrush.brush.handle import Pose
from jaxbrush.brush.shapes import BrushConfig, BrushParams
from jaxbrush.structs import state

LARGEST_LOWERING = 0.5
"""[mm] the handle may move up or down in an iteration when the force is given."""
TINY = 1e-12
"""[mm^2] A segment below this has no direction: it is left as it is, with a finite gradient."""


@state
class ProjectiveState:
    """segment: (3, n, b) [mm]. force: for x, y, z a list of m (b,) [µN]. point: the same, where
    the contact nodes were [mm]. node: (3, n, b) relative to the handle [mm] and velocity:
    (3, n, b) [mm/s], empty when quasi-static. depth: () extra lowering [mm] of force mode."""

    segment: jax.Array
    force: list
    point: jax.Array
    node: jax.Array | tuple
    velocity: jax.Array | tuple
    depth: jax.Array


def _each(matrix, x):
    """`matrix` (i, j) times each component of x (c, j, b), one batched product, (c, i, b)."""
    # A numpy matrix is tiled now; a traced one at every stamp.
    tile = np.broadcast_to if isinstance(matrix, np.ndarray) else jnp.broadcast_to
    matrix = jnp.asarray(tile(matrix, (x.shape[0], *matrix.shape)), x.dtype)
    dimensions = (((2,), (1,)), ((0,), (0,)))
    return jax.lax.dot_general(matrix, x, dimensions, precision=jax.lax.Precision.HIGHEST)


def _column_sums(x):
    """(c, n, b) to (c, b)."""
    return _each(np.ones((1, x.shape[1])), x)[:, 0]


def _inner(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _rest(params: BrushParams, rotation, segments: int):
    """Rest segments turned with the handle, (3, n, b) [mm]."""
    rest = params.rest * params.segment_length(segments)[None, None]
    return sum(rotation[:, k, None, None] * rest[None, :, k] for k in range(3))


def _base(params: BrushParams, rotation):
    """Clamp points relative to the handle, (3, b) [mm]."""
    return sum(rotation[:, j, None] * params.root[j][None] for j in range(3))


def _reaches(segments: int, nodes: int) -> np.ndarray:
    """(n, m): 1 where segment i lies between the ferrule and contact node c."""
    return (np.arange(segments)[:, None] <= np.arange(segments - nodes, segments)).astype(float)


def _running(segments: int) -> np.ndarray:
    return np.tril(np.ones((segments, segments)))


def inertia_matrix(segments: int) -> np.ndarray:
    """(n, n) kinetic form over segments, in units of the node mass: C^T M C, C the running sum."""
    mass = np.ones(segments)
    mass[-1] = 0.5
    return _running(segments).T @ (mass[:, None] * _running(segments))


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
    segment, base = _rest(params, pose.rotation, n), _base(params, pose.rotation)
    zero = jnp.zeros(params.length.shape, params.length.dtype)
    point = _each(_reaches(n, m).T, segment) + (base + pose.origin[:, None])[:, None]
    node, velocity = (), ()
    if config.integrator == "projective":
        node = _each(_running(n), segment) + base[:, None]
        velocity = jnp.zeros_like(node)
    return ProjectiveState(
        segment=segment,
        force=[[zero] * m] * 3,
        point=point,
        node=node,
        velocity=velocity,
        depth=jnp.zeros((), params.length.dtype),
    )


def _fold(d):
    """1 / (1 - d_z) of unit segments (3, n, b): what their tangent frames are built from.

    The frame is that of the least rotation from -z to d: tangents t_k with components
    delta_ka - fold d_k d_a for a in (x, y), and d_k along z. Neighbours turn little against each
    other, which keeps the bending Hessian in these frames close to the constant one. A segment
    that points straight up has no such frame; there the bound keeps it finite.
    """
    return 1.0 / jnp.maximum(1.0 - d[2], 1e-3)


def _along(d, fold, f):
    """Components of a vector f (f[0], f[1], f[2], each (n, b)) along the tangents, (2, n, b)."""
    mixed = f[2] - fold * (d[0] * f[0] + d[1] * f[1])
    # A select on the first axis instead of a stack, which would be built branch by branch.
    first = jnp.asarray([1.0, 0.0], d.dtype)[:, None, None]
    return d[:2] * mixed[None] + first * f[0][None] + (1.0 - first) * f[1][None]


def _tangents(d, fold):
    """The tangents, (2, 3, n, b)."""
    eye = jnp.eye(2, dtype=d.dtype)[:, :, None, None]
    flat = eye - (fold[None] * d[:2])[:, None] * d[None, :2]
    return jnp.concatenate([flat, d[:2, None]], axis=1)


def _worst_contact(gap, normal):
    """Share (1 or 0) of each contact node in this iteration, a list of m (b,): the node that
    breaks its condition most, the tip on a draw."""
    if len(gap) == 1:
        return [jnp.ones_like(gap[0])]
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


def _lowering(normal, target, others):
    """Extra depth at which the normal forces sum to `target`, within LARGEST_LOWERING, () [mm].

    Bisection, because stick and slip bend the curve too sharply for Newton or secant steps,
    then one linear interpolation, which also carries the gradient.

    Args:
      normal: function of the depth () to the normal forces (b,) [µN].
      target, others: () [µN].
    """

    def total(depth):
        return jnp.sum(normal(depth)) + others

    def halve(_, bracket):
        low, high = bracket
        middle = 0.5 * (low + high)
        enough = total(middle) > target
        return jnp.where(enough, low, middle), jnp.where(enough, middle, high)

    edge = jnp.full((), LARGEST_LOWERING, target.dtype)
    low, high = jax.lax.stop_gradient(jax.lax.fori_loop(0, 10, halve, (-edge, edge)))
    at_low, at_high = total(low), total(high)
    rise = at_high - at_low
    share = jnp.where(rise > 1e-3, (target - at_low) / jnp.maximum(rise, 1e-3), 0.0)
    return low + jnp.clip(share, 0.0, 1.0) * (high - low)


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
    length, stiffness = params.segment_length(n), params.bending_stiffness(n)
    soft = n / params.stretch_stiffness(n)
    by_length, by_stiffness = 1.0 / length, 1.0 / stiffness
    bending = bending_matrix(n)
    if isinstance(factor, np.ndarray):
        inverse = factor.T @ factor
    else:
        inverse = jnp.matmul(factor.T, factor, precision=jax.lax.Precision.HIGHEST)
    dynamic = config.integrator == "projective"

    rest = _rest(params, pose.rotation, n)
    offset = _base(params, pose.rotation)
    base = offset + pose.origin[:, None]
    e, force, depth = state.segment, state.force, state.depth
    if dynamic:
        mass = (
            jnp.asarray(np.append(np.ones(n - 1), 0.5)[:, None], dtype)
            * (params.mass * length)[None]
        )
        # Free flight in the handle's frame; its acceleration enters as the jump of velocity.
        flight = state.node + pose.dt * (state.velocity - pose.jump[:, None, None])
        clamp = offset[:, None]

    def places(e, depth, count):
        """The last `count` nodes on the canvas, (3, count, b)."""
        low = jnp.asarray([0.0, 0.0, 1.0], dtype)[:, None] * depth
        return _each(_reaches(n, count).T, e) + (base - low)[:, None]

    def spread(rows):
        """Force on the contact nodes, m of (b,), to the segments they pull on, (n, b)."""
        return sum(jnp.asarray(reach[:, c : c + 1], dtype) * rows[c][None] for c in range(m))

    for _ in range(config.iterations):
        place = places(e, depth, m)
        floor = surface_height(surface, place[0], place[1])
        gap = [place[2, c] - floor[c] for c in range(m)]
        chosen = _worst_contact(gap, force[2])
        inside = spread(chosen)

        elastic = _each(bending, e - rest)
        if dynamic:
            node = _each(_running(n), e) + clamp
            drag = params.damping * (node - state.node)
            pull = mass[None] / pose.dt * ((node - flight) / pose.dt + drag)
            inertial = _each(_running(n).T, pull)
        d = e * by_length[None, None]
        fold = _fold(d)
        # Forces over stiffness from here on.
        f = [by_stiffness[None] * spread(force[k]) - elastic[k] for k in range(3)]
        if dynamic:
            f = [f[k] - by_stiffness[None] * inertial[k] for k in range(3)]
        residual = _along(d, fold, f)
        whitened = _each(factor, residual)
        frame = _tangents(d, fold) * inside[None, None]
        arm = _each(factor, frame.reshape(6, n, -1)).reshape(2, 3, n, -1)
        cycled = jnp.concatenate([arm[:, 1:], arm[:, :1]], axis=1)
        xx, yy, zz = _column_sums(arm[0] * arm[0] + arm[1] * arm[1]) * by_stiffness[None]
        xy, yz, xz = _column_sums(arm[0] * cycled[0] + arm[1] * cycled[1]) * by_stiffness[None]
        moved = _column_sums(arm[0] * whitened[:1] + arm[1] * whitened[1:])

        def pick(rows, chosen=chosen):
            return sum(rows[c] * chosen[c] for c in range(m))

        fx, fy, fz = (pick(force[k]) for k in range(3))
        # What sticks is the node with its axial give, else friction would creep by that give
        # every stamp.
        away = [
            pick([place[k, c] - state.point[k, c] - soft * state.force[k][c] for c in range(m)])
            for k in range(2)
        ]
        free = (
            away[0] + moved[0] - xx * fx - xy * fy - xz * fz,
            away[1] + moved[1] - xy * fx - yy * fy - yz * fz,
            pick(gap) + moved[2] - xz * fx - yz * fy - zz * fz,
        )
        compliance = (xx + soft, xy, xz, yy + soft, yz, zz + soft)
        if target is not None:
            others = sum(jnp.sum(row) for row in force[2]) - jnp.sum(fz)

            def normal(lower, free=free, compliance=compliance, last=(fx, fy)):
                lowered = (free[0], free[1], free[2] - lower)
                return coulomb(compliance, lowered, params.friction, last)[2]

            lower = _lowering(normal, target, others)
            depth = depth + lower
            free = (free[0], free[1], free[2] - lower)
        new = coulomb(compliance, free, params.friction, (fx, fy))
        kick = [x - old for x, old in zip(new, (fx, fy, fz), strict=True)]
        force = [[force[k][c] + kick[k] * chosen[c] for c in range(m)] for k in range(3)]
        push = _along(d, fold, [(x / stiffness)[None] for x in kick])
        turn = _each(inverse, residual + inside[None] * push)
        lift = d[0] * turn[0] + d[1] * turn[1]
        e = e + jnp.concatenate([turn - d[:2] * (fold * lift)[None], lift[None]])
        square = _inner(e, e)
        alive = square > TINY
        longer = jnp.where(alive, length[None], 1.0) / jnp.sqrt(jnp.where(alive, square, 1.0))
        e = e * longer[None]

    seen = places(e, depth, config.tracked_nodes)
    node, velocity = (), ()
    if dynamic:
        node = _each(_running(n), e) + clamp
        velocity = (node - state.node) / pose.dt
    next_state = ProjectiveState(
        segment=e, force=force, point=seen[:, -m:], node=node, velocity=velocity, depth=depth
    )
    root = stiffness[None] * (3.0 * (e[:, 0] - rest[:, 0]) - (e[:, 1] - rest[:, 1]))
    first = e[:, 0] * by_length[None]
    load = [sum(force[k]) - (jnp.sum(pull[k], axis=0) if dynamic else 0.0) for k in range(3)]
    tension = sum(first[k] * (load[k] - root[k]) for k in range(3))
    contact = Contact(
        position=jnp.swapaxes(seen, 0, 1),
        force=tuple(jnp.stack(x) for x in force),
        reaction=jnp.sum(root + first * tension[None], axis=1),
    )
    return next_state, contact
