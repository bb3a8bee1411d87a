"""Draws a brush as one sees it: hair, ferrule and handle in parallel projection, shaded by hand."""

import dataclasses

import numpy as np
from matplotlib.collections import LineCollection, PolyCollection

LIGHT = np.array([-0.45, 0.35, 0.82])
HAIR = np.array([[0.30, 0.19, 0.10], [0.66, 0.45, 0.24], [0.85, 0.68, 0.43], [0.96, 0.89, 0.74]])
METAL = np.array([[0.25, 0.24, 0.24], [0.58, 0.56, 0.53], [0.80, 0.78, 0.74], [0.98, 0.97, 0.94]])
WOOD = np.array([[0.17, 0.09, 0.05], [0.37, 0.20, 0.10], [0.55, 0.33, 0.17], [0.93, 0.80, 0.60]])
PAPER = (0.992, 0.984, 0.965)
PAINT = np.array([[0.36, 0.52, 0.72], [0.10, 0.26, 0.52], [0.05, 0.12, 0.28]])
LIP, FERRULE, CRIMPS = -1.2, 13.0, (6.5, 7.9)
"""Along the handle from the clamp plane [mm]: mouth and end of the ferrule, its grooves."""


@dataclasses.dataclass(frozen=True)
class View:
    """Parallel projection; yaw: of the viewer about z [rad]. tilt: looking down [rad]."""

    yaw: float = 0.5
    tilt: float = 0.28

    def __call__(self, points):
        """(..., 3) canvas points to (..., 3): right, up, and towards the viewer [mm]."""
        x, y, z = np.moveaxis(np.asarray(points, float), -1, 0)
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        right, near = c * x - s * y, s * x + c * y
        return np.stack(
            [
                right,
                z * np.cos(self.tilt) - near * np.sin(self.tilt),
                near * np.cos(self.tilt) + z * np.sin(self.tilt),
            ],
            -1,
        )


def ramp(colors, value):
    """Colour at value (...) in [0, 1] along a ramp of colours, (..., 3)."""
    at = np.clip(value, 0.0, 1.0) * (len(colors) - 1)
    return np.stack([np.interp(at, np.arange(len(colors)), colors[:, k]) for k in range(3)], -1)


def smooth(line, factor: int = 4):
    """Catmull-Rom curve through nodes (n, ..., 3), about `factor` points a segment."""
    before = np.concatenate([2 * line[:1] - line[1:2], line[:-1]])
    after = np.concatenate([line[1:], 2 * line[-1:] - line[-2:-1]])
    u = (np.arange(factor) / factor).reshape((1, factor) + (1,) * (line.ndim - 1))
    p0, p1, p2 = before[:-1, None], line[:-1, None], line[1:, None]
    p3 = after[1:, None]
    curve = 0.5 * (
        2 * p1
        + (p2 - p0) * u
        + (2 * p0 - 5 * p1 + 4 * p2 - p3) * u**2
        + (3 * p1 - p0 - 3 * p2 + p3) * u**3
    )
    return np.concatenate([curve.reshape(-1, *line.shape[1:]), line[-1:]])


def _ring(half, power: float, count: int = 72):
    """Superellipse with half axes `half` [mm], (count, 2), and its outward normals."""
    angle = np.linspace(0.0, 2 * np.pi, count)
    c, s = np.cos(angle), np.sin(angle)
    shape = np.stack([np.sign(c) * np.abs(c) ** (2 / power), np.sign(s) * np.abs(s) ** (2 / power)])
    normal = np.stack([c / half[0], s / half[1]])
    normal = normal / np.linalg.norm(normal, axis=0)
    return (shape * np.asarray(half)[:, None]).T, normal.T


def _tube(axis, view, rotation, origin, heights, rings, colors, gloss, bands=None, zorder=3.0):
    """Shaded loft through rings (h, c, 2) at heights (h,) along the handle."""
    outline = np.concatenate(
        [rings[0], np.broadcast_to(heights[:, None, None], rings[0].shape[:2] + (1,))], -1
    )
    place = view(outline @ rotation.T + origin)
    flat = np.concatenate([rings[1], np.zeros(rings[1].shape[:2] + (1,))], -1) @ rotation.T
    facing = view(flat)[..., 2]
    light = LIGHT / np.linalg.norm(LIGHT)
    lit = flat @ light
    eye = view(np.eye(3))[:, 2]
    up = rotation[:, 2]
    across = np.cross(up, light)
    # Half way between light and eye, seen along the handle: where a turned tube shines.
    bright = light + eye / np.linalg.norm(eye)
    bright = bright - up * (bright @ up)
    glint = np.clip(flat @ (bright / np.linalg.norm(bright)), 0.0, 1.0)
    back = np.clip(flat @ (across / np.linalg.norm(across)), -1.0, 1.0)
    value = 0.20 + 0.34 * np.clip(lit, -0.4, 1.0) + gloss * glint**30 + 0.16 * facing
    value = value + 0.13 * gloss * np.cos(9.0 * back)
    if bands is not None:
        value = value + bands[:, None]
    middle = 0.25 * (value[:-1, :-1] + value[1:, :-1] + value[:-1, 1:] + value[1:, 1:])
    quads = np.stack([place[:-1, :-1], place[:-1, 1:], place[1:, 1:], place[1:, :-1]], 2)
    seen = 0.5 * (facing[:-1, :-1] + facing[:-1, 1:]) > -0.02
    color = ramp(colors, middle)
    # Into the paper near the border of the picture, where a cut would look like a broken handle.
    (left, right), (_, high) = axis.get_xlim(), axis.get_ylim()
    x, y = np.moveaxis(place[:-1, :-1, :2], -1, 0)
    inside = np.clip(np.minimum(np.minimum(x - left, right - x), high - y) / 9.0 - 0.05, 0.0, 1.0)
    color = np.array(PAPER) + (color - np.array(PAPER)) * inside[..., None]
    color = color[seen]
    axis.add_collection(
        PolyCollection(
            quads[seen][:, :, :2],
            facecolors=color,
            edgecolors=color,
            linewidths=0.3,
            zorder=zorder,
        )
    )


def draw_handle(axis, view: View, shape: str, width, thickness, rotation, origin):
    """Ferrule and wooden handle of a brush whose clamp plane is at `origin` (3,) [mm]."""
    flat = shape in ("flat", "filbert", "fan")
    mouth = np.array([0.5 * width + 0.35, 0.5 * thickness + 0.35])
    radius = 2.9 if shape != "rigger" else 1.9
    end = np.array([radius, radius])
    heights = np.unique(np.concatenate([np.linspace(LIP, FERRULE, 40), *(
        c + np.linspace(-0.5, 0.5, 9) for c in CRIMPS)]))  # fmt: skip
    groove = sum(np.exp(-(((heights - c) / 0.28) ** 2)) for c in CRIMPS)
    u = np.clip((heights - 0.5) / (FERRULE - 2.0), 0.0, 1.0)[:, None]
    u = u * u * (3.0 - 2.0 * u)
    half = (mouth * (1.0 - u) + end * u) * (1.0 - 0.05 * groove[:, None])
    power = 2.0 + (1.5 if flat else 0.0) * (1.0 - u[:, 0])
    rings = [_ring(h, p) for h, p in zip(half, power, strict=True)]
    bands = -0.28 * groove + 0.2 * np.exp(-(((heights - LIP - 0.2) / 0.25) ** 2))
    rings = np.moveaxis(np.array(rings), 1, 0)
    up = np.linspace(FERRULE - 0.4, 80.0, 120)
    belly = radius * (0.93 + 0.42 * np.exp(-(((up - FERRULE - 14.0) / 13.0) ** 2)))
    wood = np.moveaxis(np.array([_ring((r, r), 2.0) for r in belly]), 1, 0)
    _tube(axis, view, rotation, origin, up, wood, WOOD, 0.62, zorder=2.8)
    _tube(axis, view, rotation, origin, heights, rings, METAL, 0.55, bands, zorder=3.0)


def draw_hair(axis, view: View, nodes, points_per_mm: float, seed: int = 0):
    """Bristles through nodes (n + 1, 3, b) [mm], each with its own shade, and their shadow."""
    random = np.random.default_rng(seed)
    lines = smooth(np.moveaxis(nodes, 1, 2))
    count, b = lines.shape[:2]
    place = view(lines)
    depth = place[:, :, 2].mean(0)
    order = np.argsort(depth)
    rank = np.empty(b)
    rank[order] = np.linspace(0.0, 1.0, b)
    shade = 0.13 * random.standard_normal(b) + 0.26 * (rank - 0.5)

    ground = lines.copy()
    ground[..., 0] += 0.45 * ground[..., 2]
    ground[..., 1] -= 0.30 * ground[..., 2]
    ground[..., 2] = 0.0
    fade = np.clip(1.0 - lines[..., 2] / 16.0, 0.0, 1.0) ** 2
    shadow = np.moveaxis(view(ground)[..., :2], 0, 1)
    pieces = np.concatenate([shadow[:, :-2:2], shadow[:, 2::2]], -1).reshape(-1, 2, 2)
    weak = np.moveaxis(fade, 0, 1)[:, :-2:2].reshape(-1)
    color = np.concatenate(
        [np.tile([0.24, 0.18, 0.12], (len(pieces), 1)), weak[:, None] * 9.0 / b], 1
    )
    axis.add_collection(
        LineCollection(pieces, colors=color, linewidths=1.1 * points_per_mm, zorder=1.0)
    )

    along = np.linspace(0.0, 1.0, count)[:, None]
    tangent = np.gradient(lines, axis=0)
    tangent = tangent / np.linalg.norm(tangent, axis=-1, keepdims=True)
    light = LIGHT / np.linalg.norm(LIGHT)
    gloss = np.sqrt(np.clip(1.0 - (tangent @ light) ** 2, 0.0, 1.0)) ** 6
    value = 0.12 + 0.50 * along**0.8 + 0.20 * gloss + shade[None]
    color = ramp(HAIR, value)
    stroke = np.stack([place[:-1], place[1:]], 2)[..., :2]
    # Whole bristles back to front, each over a darker, wider copy of itself that parts it from
    # those behind.
    stroke = stroke[:, order].swapaxes(0, 1)
    tint = (0.5 * (color[:-1] + color[1:]))[:, order].swapaxes(0, 1)
    both = np.stack([np.broadcast_to(stroke, stroke.shape)] * 2, 1)
    tints = np.stack([tint * 0.62, tint], 1)
    taper = np.linspace(1.0, 0.55, count - 1)
    thick = np.stack([taper * 0.23, taper * 0.145]) * points_per_mm
    thick = np.broadcast_to(thick, (b, 2, count - 1))
    axis.add_collection(
        LineCollection(
            both.reshape(-1, 2, 2),
            colors=tints.reshape(-1, 3),
            linewidths=thick.reshape(-1),
            capstyle="round",
            zorder=2.5,
        )
    )


def draw_track(axis, place, force, scale: float, width: float, view=None, alpha=0.5, fade: int = 0):
    """Fine lines where bristles pressed, darker where harder.

    Args:
      place: (t, 3, b) [mm]. force: (t, b) [µN]. scale: force drawn at full `alpha` [µN].
      width: of a line [points]. view: a View, or None to look straight down. fade: stamps over
        which the oldest part comes in from nothing.
    """
    flat = np.moveaxis(place, 1, 2)
    flat = flat[..., :2] if view is None else view(flat * [1.0, 1.0, 0.0])[..., :2]
    pieces = np.stack([flat[:-1], flat[1:]], 2)
    press = np.minimum(force[:-1], force[1:])
    press = np.where((force[:-1] > 0) & (force[1:] > 0), press, 0.0)
    keep = press > 0.0
    strength = np.clip(press[keep] / scale, 0.0, 1.0) ** 0.6
    age = np.clip((np.arange(len(press)) + 1.0) / max(fade, 1), 0.0, 1.0)
    age = np.broadcast_to(age[:, None], press.shape)[keep]
    opaque = alpha * age * (0.08 + 0.92 * strength)
    color = np.concatenate([ramp(PAINT, strength), opaque[:, None]], -1)
    axis.add_collection(
        LineCollection(pieces[keep], colors=color, linewidths=width, capstyle="butt", zorder=1.5)
    )
