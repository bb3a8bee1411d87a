"""Quasi-steady motion of the paint under the brush.

The Reynolds number is about 0.01 and velocity settles in 40 us, so there is no velocity to keep:
each stamp solves for the displacement of the paint, dragged by the hair (Brinkman), held by the
canvas, free at its surface; then makes it incompressible. Viscosity cancels, for drag and
viscous stress both grow with it.

Displacements are in cells a stamp, on the faces between a cell and the next along x, y, z: a list
of three (z, y, x). The outermost faces do not move.
"""

import jax
import jax.numpy as jnp

from jaxbrush.paint.hair import Hair, corners
from jaxbrush.paint.solvers import Matrix, _last, _next, solve
from jaxbrush.paint.state import PaintConfig, PaintParams
from jaxbrush.structs import state

AXES = (-1, -2, -3)


@state
class Flow:
    """face: displacement along x, y, z, each (z, y, x) [cells]. residual: (4,) of the three
    viscous solves and the pressure, relative."""

    face: list
    residual: jax.Array


def splat(config: PaintConfig, hair: Hair, z, shape):
    """Hair in each cell.

    Args:
      z: (s, b) heights of the points after riding up [mm]. shape: (z, y, x).

    Returns:
      (phi (z, y, x) share of the cell, at most 0.5; motion (3, z, y, x) mean [cells]).
    """
    scale = jnp.asarray([config.pixel, config.pixel, config.layer], z.dtype)[:, None, None]
    place = jnp.stack([hair.place[0], hair.place[1], z]) / scale - 0.5
    index, share = corners(config, place.reshape(3, -1), shape)
    mass = hair.volume.reshape(-1)[None] * share / config.cell
    motion = hair.motion / scale
    # Hair that leaves the paint upwards lets go of it.
    motion = motion.at[2].multiply(jnp.where(motion[2] > 0.0, 0.3, 1.0)).reshape(3, 1, -1)
    cells = shape[0] * shape[1] * shape[2]
    rows = jnp.concatenate([mass[None], mass[None] * motion])
    number = jnp.arange(4, dtype=jnp.int32)[:, None, None] * cells + index[None]
    total = jnp.zeros(4 * cells, z.dtype).at[number].add(rows).reshape(4, *shape)
    phi = jnp.minimum(total[0], 0.5)
    return phi, total[1:] / jnp.maximum(total[:1], 1e-9)


def _face(a, axis, combine):
    return combine(a, _next(a, a.ndim + axis))


def _not_last(shape, axis, dtype):
    """1 on the faces inside the grid, 0 on its last ones along `axis`."""
    n = shape[axis]
    inside = (jnp.arange(n) < n - 1).astype(dtype)
    form = [1, 1, 1]
    form[axis] = n
    return inside.reshape(form)


def viscous(config: PaintConfig, params: PaintParams, fill, phi, motion):
    """Displacement of dragged, sticky paint, three (z, y, x), and residuals (3,).

    Solves (beta + L) u = beta u_hair for each component on its faces: beta = drag * phi * pixel^2;
    L the viscous 7-point operator, weighted by wetness (no stress at air), no slip on the canvas.
    """
    wet = jnp.clip(fill + phi, 0.0, 1.0)
    shape, dtype, r2 = fill.shape, fill.dtype, config.ratio
    parts = []
    for k, axis in enumerate(AXES):
        inside = _not_last(shape, axis, dtype)
        w = _face(wet, axis, jnp.minimum) * inside
        hair = _face(phi, axis, lambda a, b: 0.5 * (a + b)) * inside
        pull = _face(phi * motion[k], axis, lambda a, b: 0.5 * (a + b)) * inside
        x = jnp.minimum(w, _next(w, 2))
        y = jnp.minimum(w, _next(w, 1))
        z = r2 * jnp.minimum(w, _next(w, 0))
        diagonal = x + _last(x, 2) + y + _last(y, 1) + z + _last(z, 0)
        if k < 2:
            # The canvas is half a cell below the first layer and does not slip.
            floor = jnp.zeros(shape[0], dtype).at[0].set(2.0 * r2)
            diagonal = diagonal + floor[:, None, None] * w
        else:
            floor = jnp.zeros(shape[0], dtype).at[0].set(r2)
            diagonal = diagonal + floor[:, None, None] * w
        beta = params.drag * config.pixel**2
        # Dry faces do not move, and must not make the matrix singular.
        diagonal = diagonal + beta * hair + 1e-3
        parts.append((Matrix(diagonal, x, y, z), beta * pull))
    matrix = jax.tree.map(lambda *a: jnp.stack(a, axis=1), *[p[0] for p in parts])
    rhs = jnp.stack([p[1] for p in parts], axis=1)
    face, residual = solve("zline_pcg", matrix, rhs, config.viscous)
    return [face[:, k] for k in range(3)], residual


def divergence(face):
    """(z, y, x) of face displacements."""
    return sum(face[k] - _last(face[k], 3 + axis) for k, axis in enumerate(AXES))


def project(config: PaintConfig, params: PaintParams, fill, phi, face):
    """Makes the displacement volume-preserving where there is liquid.

    Overfull cells are sources; pressure is 0 in air; canvas and window sides are closed; the bed
    of hair is full of paint that cannot escape upwards for free, so faces from liquid up into air
    open only as far as there is no hair.

    Returns:
      (three faces (z, y, x), relative residual ()).
    """
    liquid = (fill + phi >= 0.5).astype(fill.dtype)
    source = params.source * jnp.maximum(fill + phi - 1.0, 0.0)
    lid = 1.0 - params.lid * jnp.minimum(1.0, phi / 0.15)
    weights, coupling, diagonal = [], [], 0.0
    for k, axis in enumerate(AXES):
        n = 3 + axis
        inside = _not_last(fill.shape, axis, fill.dtype)
        either = jnp.maximum(liquid, _next(liquid, n)) * inside
        both = liquid * _next(liquid, n) * inside
        scale = config.ratio if k == 2 else 1.0
        open_ = jnp.maximum(both, either * lid) if k == 2 else either
        weight = scale * open_
        weights.append(weight)
        coupling.append(scale * both)
        diagonal = diagonal + weight + _last(weight, n)
    diagonal = jnp.where(liquid > 0.0, diagonal, 1.0)
    diagonal = jnp.maximum(diagonal, 1e-6)
    matrix = Matrix(diagonal, *coupling)
    rhs = liquid * (source - divergence(face))
    pressure, residual = solve(config.solver, matrix, rhs, config.pressure)
    pressure = pressure * liquid
    moved = [
        face[k] - weights[k] * (_next(pressure, 3 + axis) - pressure) for k, axis in enumerate(AXES)
    ]
    return moved, residual


def stop(params: PaintParams, config: PaintConfig, face, step):
    """Yield: paint that would move less than a share of the brush's travel stands still.

    A cut on speed, in place of a stress: smooth above the threshold.

    Args:
      step: () travel of the brush in the stamp [mm].
    """
    # A brush at rest moves nothing either, and no rounding does.
    threshold = jnp.maximum(params.yield_share * step / config.pixel, 1e-4)
    square = 0.0
    for k, axis in enumerate(AXES):
        scale = config.layer / config.pixel if k == 2 else 1.0
        middle = 0.5 * scale * (face[k] + _last(face[k], 3 + axis))
        square = square + middle * middle
    keep = jnp.clip(1.0 - threshold / jnp.sqrt(square + 1e-12), 0.0, 1.0)
    return [face[k] * jnp.maximum(keep, _next(keep, 3 + axis)) for k, axis in enumerate(AXES)]


def flow(config: PaintConfig, params: PaintParams, fill, phi, motion, step) -> Flow:
    """Displacement of the paint in one stamp."""
    face, rough = viscous(config, params, fill, phi, motion)
    face, residual = project(config, params, fill, phi, face)
    face = stop(params, config, face, step)
    return Flow(face=face, residual=jnp.concatenate([rough, residual[None]]))
