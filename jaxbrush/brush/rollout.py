"""A whole stroke: stylus in, bristle motion and contact force out, in one scan."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.brush import explicit, guides, implicit, projective
from jaxbrush.brush.contact import Surface
from jaxbrush.brush.handle import poses
from jaxbrush.brush.shapes import BrushConfig, BrushParams
from jaxbrush.structs import state
from jaxbrush.stylus import Stroke


@state
class BristleTrack:
    """The part of the bristles near the canvas, at t stamps; m tracked nodes, tip last.

    time: (t,) [s]. position: (t, m, 3, b) [mm] on the canvas. force: (t, m, b) normal force of
    the canvas [µN]. reaction: (t, 3) force of all bristles on the ferrule [µN]. valid: (t,)
    False on padding.
    """

    time: jax.Array
    position: jax.Array
    force: jax.Array
    reaction: jax.Array
    valid: jax.Array

    @property
    def velocity(self):
        """(t, m, 2, b) mean velocity along the canvas since the stamp before [mm/s]; the first
        stamp has that of the second."""
        path = self.position[:, :, :2]
        dt = self.time[1:] - self.time[:-1]
        moving = (dt > 0.0) & self.valid[1:]
        rate = jnp.where(moving, 1.0 / jnp.where(moving, dt, 1.0), 0.0)
        velocity = (path[1:] - path[:-1]) * rate[:, None, None, None]
        return jnp.concatenate([velocity[:1], velocity])

    @property
    def contact(self):
        """(..., t, m, b) whether a node presses on the canvas at a valid stamp."""
        return (self.force > 0.0) & self.valid[..., None, None]


def _check(config: BrushConfig, params: BrushParams, stroke: Stroke):
    n, b = config.segments, params.length.shape[-1]
    if params.rest.shape != (n, 3, b):
        raise ValueError(
            f"params.rest has shape {params.rest.shape}: expected {(n, 3, b)} "
            f"(nodes - 1, 3, bristles) for config.nodes = {config.nodes}"
        )
    if params.root.shape != (3, b):
        raise ValueError(f"params.root has shape {params.root.shape}: expected {(3, b)}")
    if stroke.position.ndim != 2 or stroke.position.shape[1] != 2:
        raise ValueError(
            f"stroke.position has shape {stroke.position.shape}: expected (t, 2); vmap over strokes"
        )
    if config.guides > b:
        raise ValueError(f"config.guides = {config.guides}: expected at most the {b} bristles")


def rollout(
    config: BrushConfig, params: BrushParams, stroke: Stroke, surface: Surface | None = None
) -> BristleTrack:
    """Moves the bristles of one brush along one stroke.

    A pure function: jit it, vmap it over strokes or parameters, differentiate it in both. The
    arrays are in the float type of `params`.

    Args:
      config: static choices; the integrator, its iterations and substeps.
      params: the brush, b bristles.
      stroke: t stamps, from `stylus.resample`; padding stays where the stroke ends.
      surface: height of what is painted on, or None for the plane z = 0.

    Returns:
      BristleTrack of the t stamps (the approach is not part of it).

    Raises:
      ValueError: shapes of `params` and `config` that do not fit, while tracing.
    """
    _check(config, params, stroke)
    followed, moved = None, params
    if 0 < config.guides < params.length.shape[0]:
        followed = guides.choose(params, config.guides)
        moved = guides.take(params, followed)
    press = config.press == "depth"
    solved = solved_stamps(stroke.time.shape[0], config.solve_stride)
    few = jax.tree.map(lambda x: x[solved], stroke)
    track = _solve(config, moved, few, poses(params, few, config.approach, press), surface)
    if len(solved) < stroke.time.shape[0]:
        handle = poses(params, stroke, 0, press).origin[:, :2]
        track = _between(track, stroke, handle, solved, config.solve_stride)
    if followed is None:
        return track
    rotation = poses(params, stroke, 0, press).rotation
    return guides.follow(config, params, rotation, track, followed, surface)


def solved_stamps(stamps: int, stride: int) -> np.ndarray:
    """Indices of the stamps that are solved: every `stride`-th, and the last."""
    return np.unique(np.append(np.arange(0, stamps - 1, stride), stamps - 1))


def _between(track, stroke, handle, solved, stride):
    """The track at every stamp of `stroke` from the track at the stamps `solved`, linear in what
    the bristles do against the handle (t, 2), which itself is exact at every stamp."""
    first, count = solved[:-1], len(solved) - 1
    share = np.arange(stride)[None] / (solved[1:] - first)[:, None]
    stamps = stroke.time.shape[0]
    apart = stamps - count * stride

    def fill(x):
        tail = (1,) * (x.ndim - 1)
        weight = jnp.asarray(share, x.dtype).reshape(count, stride, *tail)
        between = x[:-1, None] + weight * (x[1:, None] - x[:-1, None])
        between = between.reshape(count * stride, *x.shape[1:])[:stamps]
        return jnp.concatenate([between, x[-1:]]) if apart > 0 else between

    def along(x):
        return jnp.pad(x, ((0, 0), (0, 1)))[:, None, :, None].astype(track.position.dtype)

    # XLA works sums out again for each of their many readers downstream, but never a division:
    # dividing by a traced 1 keeps the track as an array (a fifth of the time of rollout and maps).
    one = 1.0 + 0.0 * stroke.time[0].astype(track.position.dtype)
    return BristleTrack(
        time=stroke.time,
        position=(fill(track.position - along(handle[solved])) + along(handle)) / one,
        force=fill(track.force) / one,
        reaction=fill(track.reaction),
        valid=stroke.valid,
    )


def _project(config, params, start, pose, load, surface):
    """Scans the fast integrators over poses. Returns (state, what each stamp saw)."""
    factor = None
    if config.integrator == "projective":
        factor = jax.vmap(lambda dt: projective.dynamic_inverse_factor(config, params, dt))(pose.dt)
    constant = projective.inverse_factor(config.segments)

    def body(carry, inputs):
        pose, q, force = inputs
        q = constant if q is None else q
        target = force if config.press == "force" else None
        carry, contact = projective.step(config, params, carry, pose, q, target, surface)
        return carry, (contact.position, contact.force[2], contact.reaction)

    return jax.lax.scan(body, start, (pose, factor, load))


def _load(params, stroke, approach: int):
    load = params.press_force * stroke.pressure.astype(params.length.dtype)
    return jnp.concatenate([jnp.zeros(approach, load.dtype), load])


def _solve(config, params, stroke, pose, surface):
    first = jax.tree.map(lambda x: x[0], pose)
    if config.integrator in ("quasi_static", "projective"):
        start = projective.init(config, params, first)
        load = _load(params, stroke, config.approach)
        _, seen = _project(config, params, start, pose, load, surface)
    else:
        module = implicit if config.integrator == "implicit_euler" else explicit
        start = module.init(config, params, first)

        def body(carry, pose):
            carry, contact = module.step(config, params, carry, pose, surface)
            return carry, (contact.position, contact.force[2], contact.reaction)

        _, seen = jax.lax.scan(body, start, pose)

    return _track(stroke, jax.tree.map(lambda x: x[config.approach :], seen))


def _track(stroke, seen):
    position, force, reaction = seen
    above = position.shape[1] - force.shape[1]
    return BristleTrack(
        time=stroke.time,
        position=position,
        force=jnp.pad(force, ((0, 0), (above, 0), (0, 0))),
        reaction=reaction,
        valid=stroke.valid,
    )


@state
class Motion:
    """A stroke that is still being drawn. bristles: at its last stamp. seen: position, force and
    reaction there."""

    bristles: projective.ProjectiveState
    seen: tuple


def begin(config: BrushConfig, params: BrushParams, stroke: Stroke) -> Motion:
    """Lowers a brush onto the first stamp of a stroke, to go on by `advance`. Pure.

    Raises:
      ValueError: an integrator other than "quasi_static", or guides.
    """
    _check(config, params, stroke)
    if config.integrator != "quasi_static" or config.guides:
        raise ValueError(
            f"integrator = {config.integrator!r}, guides = {config.guides}: expected "
            "'quasi_static' without guides for a stroke in pieces"
        )
    first = jax.tree.map(lambda x: x[:1], stroke)
    pose = poses(params, first, config.approach, config.press == "depth")
    start = projective.init(config, params, jax.tree.map(lambda x: x[0], pose))
    load = _load(params, first, config.approach)
    bristles, seen = _project(config, params, start, pose, load, None)
    return Motion(bristles=bristles, seen=jax.tree.map(lambda x: x[-1], seen))


def advance(
    config: BrushConfig, params: BrushParams, motion: Motion, stroke: Stroke
) -> tuple[BristleTrack, Motion]:
    """Moves a brush along the next piece of a stroke. Pure; costs what the piece costs.

    Pieces of t stamps, t - 1 a multiple of `config.solve_stride`, give the track of `rollout`.

    Args:
      motion: from `begin`, or from the piece before.
      stroke: t >= 2 stamps, the first of which is the last of the piece before. Where the last are
        padding, the motion that is returned is of no use.

    Returns:
      (BristleTrack of the t stamps, Motion).
    """
    _check(config, params, stroke)
    stamps, press = stroke.time.shape[0], config.press == "depth"
    solved = solved_stamps(stamps, config.solve_stride)
    few = jax.tree.map(lambda x: x[solved], stroke)
    pose = jax.tree.map(lambda x: x[1:], poses(params, few, 0, press))
    bristles, seen = _project(
        config, params, motion.bristles, pose, _load(params, few, 0)[1:], None
    )
    last = jax.tree.map(lambda x: x[-1], seen)
    seen = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), motion.seen, seen)
    track = _track(few, seen)
    if len(solved) < stamps:
        handle = poses(params, stroke, 0, press).origin[:, :2]
        track = _between(track, stroke, handle, solved, config.solve_stride)
    return track, Motion(bristles=bristles, seen=last)
