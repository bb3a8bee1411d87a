"""Bristle tracks made by hand, and maps drawn the slow, obvious way, for the raster tests."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.brush import BristleTrack
from jaxbrush.raster import make_grid, trajectory_maps
from jaxbrush.raster.exact import MOMENTS
from jaxbrush.raster.sweeps import TIP_STIFFNESS

PIXEL = 0.125
"""Whole pixels, and positions of a 64th of one, are exact in float32."""
WIDTH, SIDE, STAMPS, BRISTLES = 0.375, 48, 240, 6
STATIC = ("width", "edge", "nodes", "longest")
draw = jax.jit(trajectory_maps, static_argnames=STATIC)


def canvas(origin=(0.0, 0.0), side=SIDE, pixel=PIXEL):
    return make_grid((side, side), origin, pixel)


def make_track(path, force=100.0, height=0.0, time=None, valid=None, nodes=1):
    """A track from the paths (t, 2) or (t, 2, b) [mm] of its tips.

    force [µN] and height [mm] broadcast to (t, b); nodes above the tip are in the air, beside it.
    """
    path = np.asarray(path, float)
    path = path[..., None] if path.ndim == 2 else path
    t, _, b = path.shape
    tip = np.concatenate([path, np.broadcast_to(height, (t, b))[:, None]], axis=1)
    position = np.stack([tip + [[0.0], [0.7 * k], [0.5 * k]] for k in range(nodes)][::-1], axis=1)
    load = np.zeros((t, nodes, b))
    load[:, -1] = force
    return BristleTrack(
        time=jnp.asarray(0.01 * np.arange(t) if time is None else time, float),
        position=jnp.asarray(position, float),
        force=jnp.asarray(load, float),
        reaction=jnp.zeros((t, 3)),
        valid=jnp.asarray(np.ones(t) if valid is None else valid, bool),
    )


def random_track(seed=0, stamps=24, bristles=6, size=5.0, step=0.35, air=0.4, rest=0.15, leap=0.06):
    """Tips that wander inside size x size mm, rest, leap, lift off and come down again."""
    rng = np.random.default_rng(seed)
    turn = np.cumsum(rng.normal(0.0, 0.8, (stamps, bristles)), axis=0)
    length = step * rng.uniform(0.0, 1.5, (stamps, bristles))
    length[rng.random((stamps, bristles)) < rest] = 0.0
    length[rng.random((stamps, bristles)) < leap] = 0.5 * size
    way = np.stack([length * np.cos(turn), length * np.sin(turn)], axis=1)
    path = rng.uniform(0.0, size, (2, bristles)) + np.cumsum(way, axis=0)
    # Mirrored at the borders, so that long walks stay inside.
    path = size - np.abs(np.mod(path, 2.0 * size) - size)
    lifted = rng.random((stamps, bristles)) < air
    force = np.where(lifted, 0.0, rng.uniform(5.0, 200.0, (stamps, bristles)))
    height = np.where(lifted, rng.uniform(0.0, 2.0, (stamps, bristles)), 0.0)
    time = np.cumsum(rng.uniform(0.001, 0.02, stamps)) + 3.0
    return make_track(path, force, height, time)


def colors(bristles, seed=7):
    return np.random.default_rng(seed).uniform(0.1, 1.0, (bristles, 3))


def padded(track, stamps=STAMPS, bristles=BRISTLES):
    """The track with stamps that are not valid, and bristles that never touch, up to a size that
    all tests share, so that it compiles once. The invalid stamps hold what must not be used."""
    # By numpy: every new shape would compile several small functions.
    junk = {"time": 99.0, "position": 1.0, "force": 50.0, "reaction": 0.0, "valid": False}
    t, m, _, b = track.position.shape
    track = jax.tree.map(np.asarray, track)
    away = np.broadcast_to(np.array([3.0, 3.0, 5.0])[:, None], (t, m, 3, bristles - b))
    track = dataclasses.replace(
        track,
        position=np.concatenate([track.position, away.astype(track.position.dtype)], axis=-1),
        force=np.pad(track.force, ((0, 0), (0, 0), (0, bristles - b))),
    )

    def longer(name, x):
        more = np.full((stamps - t, *x.shape[1:]), junk[name], x.dtype)
        return jnp.asarray(np.concatenate([x, more]))

    return BristleTrack(**{name: longer(name, getattr(track, name)) for name in junk})


def exact_maps(track, color=None, grid=None):
    """Exact maps by the one compiled function that most tests share."""
    color = colors(BRISTLES) if color is None else np.resize(color, (BRISTLES, 3))
    return draw(canvas() if grid is None else grid, padded(track), color, width=WIDTH)


def stack(tracks):
    return jax.tree.map(lambda *x: jnp.stack(x), *tracks)


def moved(track, by):
    """The track shifted by (x, y) [mm]."""
    by = jnp.asarray([*by, 0.0], track.position.dtype)
    return dataclasses.replace(track, position=track.position + by[None, None, :, None])


def leaves(maps):
    """(name, array) of every map."""
    return [(f.name, np.asarray(getattr(maps, f.name))) for f in dataclasses.fields(maps)]


def assert_same(got, want, window=(slice(None), slice(None))):
    """Bit for bit, in a window of `want`."""
    for (name, a), (_, b) in zip(leaves(got), leaves(want), strict=True):
        np.testing.assert_array_equal(a, b[window] if b.ndim > 1 else b, err_msg=name)


def assert_finite(tree):
    for leaf in jax.tree.leaves(tree):
        if np.issubdtype(leaf.dtype, np.floating):
            assert np.all(np.isfinite(np.asarray(leaf)))


@dataclasses.dataclass
class Reference:
    """Exact maps by loops, and what the comparison needs to know.

    bristle: that came last, -1 where none did. passes: how often one came. force [µN], when
    [s]: at which it left; fall, pace: their changes a pixel of its way. rim: whether the pixel is
    near the side of that sweep, where the way to its end is cut off. tie: several bristles at the
    latest moment of the latest stamp; shared: at that stamp. unsure: some sweep ends so close to
    the pixel, or leaves it so close to the turn of a moment, that rounding may decide.
    """

    bristle: np.ndarray
    passes: np.ndarray
    force: np.ndarray
    when: np.ndarray
    fall: np.ndarray
    pace: np.ndarray
    rim: np.ndarray
    tie: np.ndarray
    shared: np.ndarray
    unsure: np.ndarray


def trailing_last(start, way, force):
    """Bristles from the foremost to the last along their mean motion: starts and ways (2, b)."""
    motion = way[:, force > 0].sum(axis=1)
    return sorted(range(len(force)), key=lambda b: (-float(start[:, b] @ motion), b))


def reference(grid, track, width, order="moment", tiny=2e-3) -> Reference:
    """Loops over stamps, bristles (tips only) and pixels in float64: plain geometry.

    order: of the bristles of a stamp over a pixel the latest is that which leaves it last, to a
    "moment", and of those of one moment the last by number; or that of the last "number"; or the
    one that is "trailing", as in soft maps.
    """
    h, w = grid.shape
    ys, xs = np.mgrid[:h, :w].astype(float)
    tip = np.asarray(track.position, float)[:, -1]
    force = np.asarray(track.force, float)[:, -1]
    place = (tip[:, :2] - np.asarray(grid.origin, float)[None, :, None]) / grid.pixel - 0.5
    depth = np.where(force > 0, force / TIP_STIFFNESS, -np.maximum(np.abs(tip[:, 2]), 1e-6))
    stamps, bristles = force.shape
    radius = 0.5 * width / grid.pixel
    time = np.asarray(track.time, float)
    number, boolean = lambda: np.zeros((h, w)), lambda: np.zeros((h, w), bool)  # noqa: E731
    out = Reference(
        bristle=np.full((h, w), -1), passes=np.zeros((h, w), int), force=number(), when=number(),
        fall=number(), pace=number(), rim=boolean(), tie=boolean(), shared=boolean(),
        unsure=boolean(),
    )  # fmt: skip
    stamp_of, moment_of = np.full((h, w), -1), np.full((h, w), -1)
    before, turn = np.zeros((bristles, h, w), bool), boolean()
    for t in range(stamps):
        s = max(t - 1, 0)
        pressed = np.maximum(depth[s], depth[t])
        turns = range(bristles)
        if order == "trailing":
            turns = trailing_last(place[s], place[t] - place[s], pressed)
        for b in turns:
            d0, d1 = depth[s, b], depth[t, b]
            if max(d0, d1) <= 0 or not bool(track.valid[t]):
                before[b] = False
                continue
            start, way = place[s, :, b], place[t, :, b] - place[s, :, b]
            low = 0.0 if d0 > 0 or t == 0 else d0 / (d0 - d1)
            high = 1.0 if d1 > 0 else d0 / (d0 - d1)
            length = np.hypot(*way)
            along = way / length if length > 0 else np.array([1.0, 0.0])
            rx, ry = xs - start[0], ys - start[1]
            # Along and across the sweep, in its own frame.
            u, v = rx * along[0] + ry * along[1], ry * along[0] - rx * along[1]
            distance = np.hypot(u - np.clip(u, low * length, high * length), v)
            covered = distance <= radius
            out.unsure |= np.abs(distance - radius) < tiny
            leave = np.minimum(u + np.sqrt(np.maximum(radius**2 - v**2, 0.0)), high * length)
            share = leave / length if length > 0 else high + 0.0 * u
            moment = np.minimum(np.floor(MOMENTS * share), MOMENTS - 1)
            # Near the turn of a moment, by how far rounding moves a bristle.
            off = np.abs(MOMENTS * share - np.round(MOMENTS * share))
            close = (off * length < MOMENTS * 1e-4) & (share < 1.0)
            same = stamp_of == t
            turn = np.where(covered, close | (turn & same), turn)
            later = covered & (~same | (moment >= moment_of) | (order != "moment"))
            gain, span = force[t, b] - force[s, b], time[t] - time[s]
            for name, value in (
                ("tie", same & (moment == moment_of)),
                ("bristle", b),
                ("force", force[s, b] + share * gain),
                ("when", time[s] + share * span),
                ("fall", abs(gain) / length if length > 0 else 0.0),
                ("pace", span / length if length > 0 else 0.0),
                ("rim", v**2 > 0.89 * radius**2),
            ):
                field = getattr(out, name)
                field[later] = np.broadcast_to(value, (h, w))[later]
            out.shared[covered] = same[covered]
            stamp_of[covered], moment_of[later] = t, moment[later]
            out.passes += covered & ~before[b]
            before[b] = covered
    if order == "moment":
        out.unsure |= turn & out.shared
    return out
