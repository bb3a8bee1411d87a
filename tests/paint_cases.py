"""Strokes that the tests of the paint simulator share: one size, so one compilation for all."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.brush import BristleTrack
from jaxbrush.paint import (
    PaintConfig,
    empty_canvas,
    height,
    load_brush,
    make_params,
    paint_stroke,
)

CONFIG = PaintConfig(layers=8, window=24, pigments=2, samples=4, solver="chebyshev")
BRISTLES, STAMPS, SIDE = 40, 64, 56
"""Bristles; stamps that every stroke is padded to; cells along a side of the canvas."""
MIDDLE = 0.5 * SIDE * CONFIG.pixel
stroke = jax.jit(paint_stroke)


def params_of(**changes):
    """Constants for this little brush."""
    return make_params(
        **({"tip_volume": 1.2, "reservoir_volume": 9.0, "contact_area": 3.0} | changes)
    )


def track(x=1.5, y=MIDDLE, low=0.02, length=3.6, step=0.12, angle=0.0, speed=60.0, stamps=STAMPS):
    """Bristles on a field of 1 x 1.5 mm, pulled from (x, y) by `length` along `angle` [rad], tips
    at height `low`, stamps `step` apart [mm]."""
    rng = np.random.default_rng(0)
    root = rng.uniform(-0.5, 0.5, (2, BRISTLES)) * np.array([[1.0], [1.5]])
    rough = 0.05 * rng.uniform(size=BRISTLES)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    way = np.minimum(step * np.arange(stamps), length)
    tip = np.empty((stamps, 3, BRISTLES))
    at = np.array([x, y])[:, None] + turn @ np.stack([way, 0.0 * way])
    tip[:, :2] = at.T[:, :, None] + (turn @ root)[None]
    tip[:, 2] = low + rough
    lean = np.append(turn @ [0.6, 0.0], 0.8)
    return track_of(tip, lean, way / speed, np.arange(stamps) <= np.ceil(length / step - 1e-6))


def pulled(low=0.02, y=3.0, travel=0.12, start=2.0, valid=24):
    """The same bristles pulled along x from (start, y), 24 stamps `travel` apart [mm], of which
    the first `valid` count."""
    first = track(x=start, y=y, low=low, length=0.0)
    tip = np.repeat(np.asarray(first.position[:1, -1], np.float64), 24, axis=0)
    tip[:, 0] += travel * np.arange(24)[:, None]
    return track_of(tip, valid=np.arange(24) < valid)


def track_of(tip, lean=(0.6, 0.0, 0.8), time=None, valid=None):
    """A track of given tips (t, 3, b) [mm], the node above each a millimetre along `lean`."""
    stamps, _, bristles = tip.shape
    time = 0.002 * np.arange(stamps) if time is None else time
    valid = np.ones(stamps, bool) if valid is None else valid
    position = np.stack([tip + np.asarray(lean)[None, :, None], tip], axis=1)
    return BristleTrack(
        time=jnp.asarray(time, jnp.float32),
        position=jnp.asarray(position, jnp.float32),
        force=jnp.ones((stamps, 2, bristles), jnp.float32),
        reaction=jnp.zeros((stamps, 3), jnp.float32),
        valid=jnp.asarray(valid),
    )


def bare():
    return empty_canvas(CONFIG, (SIDE, SIDE))


def slab(depth: float, pigment: int = 1, where=slice(None)):
    """A canvas under `depth` [mm] of paint, in the columns `where` along x."""
    fill = np.clip(depth / CONFIG.layer - np.arange(CONFIG.layers), 0.0, 1.0)
    return bare().at[:, pigment, :, where].set(jnp.asarray(fill, float)[:, None, None])


def brush_of(load=0.8, mix=(1.0, 0.0), params=None):
    params = params_of() if params is None else params
    return load_brush(CONFIG, params, BRISTLES, load, jnp.asarray(mix, float))


def paint(canvas=None, brush=None, params=None, moves=None, **where):
    """(canvas, brush, report) after a stroke."""
    params = params_of() if params is None else params
    canvas = bare() if canvas is None else canvas
    brush = brush_of(params=params) if brush is None else brush
    moves = track(**where) if moves is None else moves
    return stroke(CONFIG, params, canvas, brush, moves)


def held(brush):
    """(k,) of a brush [mm^3], summed in double precision."""
    tip, behind = np.asarray(brush.tip, np.float64), np.asarray(brush.reservoir, np.float64)
    return tip.sum(1) + behind.sum(1)


def total(canvas, brush):
    """(k,) of canvas and brush [mm^3]."""
    return CONFIG.cell * np.asarray(canvas, np.float64).sum((0, 2, 3)) + held(brush)


def film(canvas):
    """(y, x) thickness [mm]."""
    return np.asarray(height(CONFIG, canvas), np.float64)


def check_sound(before, after):
    """Finite, nowhere negative, and each pigment conserved: (canvas, brush) twice."""
    for x in (*jax.tree.leaves(after),):
        x = np.asarray(x)
        assert np.all(np.isfinite(x)) and x.min() >= 0.0
    np.testing.assert_allclose(total(*after), total(*before), rtol=1e-6, atol=1e-9)
