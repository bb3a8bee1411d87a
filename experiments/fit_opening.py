"""The opening of a fit: moves a stroke to where its maps say the brush was, without a gradient.

The time map tells what was painted last in each part of the stroke's time. Its centre and force
are measured on the maps that are read and on those of the present stroke; the path moves by the
difference of the centres, the pressure by the ratio of the forces, both smoothed. Where later
paint hides what came before, the smooth curve goes on from both sides.
"""

import numpy as np

from experiments.fit_loss import PIXEL, clock

BINS = 48
"""Parts of a stroke's time."""
POINTS = 24
"""Control points of the curves in the opening."""
ENOUGH = 1.0
"""Area of a part that says half as much as the largest could [mm^2]."""
SMOOTH = (0.1, 0.03, 0.01)
"""Weights of the squared third differences of the control points against a part's [mm^2]: the
first suits most strokes, the last a scribble."""


def basis(stamps: int, count: int) -> np.ndarray:
    """Cubic B-splines with evenly spaced knots, (stamps, count); rows sum to 1."""
    at = np.linspace(0.0, count - 3.0, stamps)[:, None] - np.arange(-1, count - 1)[None]
    far = np.abs(at)
    near = 2.0 / 3.0 - far**2 + 0.5 * far**3
    return np.where(far < 1.0, near, np.clip(2.0 - far, 0.0, None) ** 3 / 6.0)


def moments(maps) -> np.ndarray:
    """What was touched last in each part of the stroke's time, (BINS, 4): its centre x, y [mm]
    from the corner of the maps, its mean pressure and its area [mm^2]."""
    y, x = np.nonzero(np.asarray(maps.coverage))
    at = np.asarray(clock(maps))[y, x] * (BINS - 1)
    force = np.asarray(maps.pressure)[y, x]
    rows = np.stack([PIXEL * (x + 0.5), PIXEL * (y + 0.5), force, np.ones_like(force)])
    share = np.clip(1.0 - np.abs(at[None] - np.arange(BINS)[:, None]), 0.0, None)
    sums = share @ rows.T
    area = PIXEL**2 * sums[:, 3:]
    return np.concatenate([sums[:, :3] / np.maximum(sums[:, 3:], 1e-9), area], axis=1)


def moved(curve: np.ndarray, drawn, read, smooth: float = SMOOTH[0]) -> np.ndarray:
    """The next curve: x, y [mm] and logit of the pressure, (t, 3).

    Args:
      curve: (t, 3), evenly spaced in time. drawn: its exact maps. read: the maps to match.
      smooth: one of SMOOTH.
    """
    now, then = moments(drawn), moments(read)
    area = np.minimum(now[:, 3], then[:, 3])
    trust = (area / (area + ENOUGH)) ** 2
    press = np.log((then[:, 2] + 0.01) / (now[:, 2] + 0.01)).clip(-1.0, 1.0)
    step = np.concatenate([then[:, :2] - now[:, :2], press[:, None]], axis=1)
    at = np.linspace(0.0, len(curve) - 1.0, BINS)
    wanted = np.stack([np.interp(at, np.arange(len(curve)), x) for x in curve.T], 1) + step
    b, bend = basis(BINS, POINTS), np.diff(np.eye(POINTS), 3, axis=0)
    matrix = b.T @ (trust[:, None] * b) + smooth * bend.T @ bend
    points = np.linalg.solve(matrix, b.T @ (trust[:, None] * wanted))
    return basis(len(curve), POINTS) @ points
