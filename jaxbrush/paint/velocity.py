"""Quasi-steady motion of the paint under the brush.

The Reynolds number is about 0.01 and velocity settles in 40 us, so there is no velocity to keep:
each stamp solves for the displacement of the paint, dragged by the hair (Brinkman), held by the
canvas, free at its surface; then makes it incompressible. Viscosity cancels, for drag and
viscous stress both grow with it.

Fields are flat planes (z, n), n = y * x. Displacements are in cells a stamp; those on faces, a
list along x, y, z, lie between a cell and the next, and the outermost faces do not move.
"""

import jax
import jax.numpy as jnp

from jaxbrush.paint.hair import Hair, corners
from jaxbrush.paint.solvers import Matrix, residual, solve
from jaxbrush.paint.state import PaintConfig, PaintParams
from jaxbrush.paint.stencil import inner_x, inner_y, near, stored, wide
from jaxbrush.structs import state


@state
class Flow:
    """face: displacement along x, y, z, each (z + 2, n + 2 width), wide [cells]. residual: (4,) of
    the viscous solves and the pressure, relative."""

    face: list
    residual: jax.Array


def splat(config: PaintConfig, hair: Hair, z):
    """Hair in each cell.

    Args:
      z: (s, b) heights of the points after riding up [mm].

    Returns:
      (phi (z, n) share of the cell, at most 0.5; motion (z, 3, n) mean [cells]).
    """
    shape = (config.layers, config.window, config.window)
    scale = jnp.asarray([config.pixel, config.pixel, config.layer], z.dtype)[:, None, None]
    place = jnp.stack([hair.place[0], hair.place[1], z]) / scale - 0.5
    index, share = corners(config, place.reshape(3, -1), shape)
    mass = hair.volume.reshape(-1)[None] * share / config.cell
    motion = hair.motion / scale
    # Hair that leaves the paint upwards lets go of it.
    motion = motion.at[2].multiply(jnp.where(motion[2] > 0.0, 0.3, 1.0)).reshape(3, 1, -1)
    plane = config.window**2
    rows = jnp.concatenate([mass[None], mass[None] * motion])
    # (4, 8, n) into (z, 4, n)
    level, column = jax.lax.div(index, plane), jax.lax.rem(index, plane)
    number = (4 * level[None] + jnp.arange(4, dtype=jnp.int32)[:, None, None]) * plane + column[
        None
    ]
    total = jnp.zeros(4 * shape[0] * plane, z.dtype).at[number].add(rows)
    total = total.reshape(shape[0], 4, plane)
    phi = jnp.minimum(total[:, 0], 0.5)
    return phi, total[:, 1:] / jnp.maximum(total[:, :1], 1e-9)


def viscous(config: PaintConfig, params: PaintParams, fill, phi, motion):
    """Displacement of dragged, sticky paint, (z, 3, n + 2 width), and residuals (3,).

    Solves (beta + L) u = beta u_hair in the cells: beta = drag * phi * pixel^2; L the viscous
    7-point operator, weighted by wetness (no stress at air), no slip on the canvas, half a cell
    below the first layer.
    """
    one = 1.0 + 0.0 * params.drag
    wet = jnp.clip(fill + phi, 0.0, 1.0)
    beta = params.drag * config.pixel**2 * phi
    floor = jnp.zeros((config.layers, 1), fill.dtype).at[0].set(2.0 * config.ratio)
    # Dry cells do not move, and must not make the matrix singular.
    extra = (beta + floor * wet + 1e-3) / one
    matrix = Matrix(wide(wet, config.window), extra, config.ratio, config.window)
    rhs = beta[:, None] * motion / one
    u = solve("chebyshev", matrix, rhs, config.viscous, config.spectrum)
    return u, residual(matrix, u[..., config.window : -config.window], rhs)


def faces_of(config: PaintConfig, u):
    """Displacements of cells, (z, 3, n + 2 width), on the faces between them, each (z, n)."""
    size = config.window
    inside = (inner_x(size, size), inner_y(size, size))
    faces = []
    for k, shift in enumerate((1, size)):
        here = jax.lax.slice_in_dim(u[:, k], size, -size, axis=1)
        there = u[:, k, size + shift : u.shape[2] - size + shift]
        faces.append(0.5 * (here + there) * jnp.asarray(inside[k], u.dtype)[None])
    here = u[:, 2, size:-size]
    up = 0.5 * (here[:-1] + here[1:])
    return [*faces, jnp.concatenate([up, jnp.zeros_like(up[:1])])]


def divergence(face, width: int):
    """(z, n) of wide face displacements."""
    total = 0.0
    for f, shift, layer in zip(face, (-1, -width, 0), (0, 0, -1), strict=True):
        total = total + near(f, width) - near(f, width, shift, layer)
    return total


def pressure_system(config: PaintConfig, params: PaintParams, fill, phi, face):
    """The pressure's equations in one stamp.

    Args:
      face: wide displacements.

    Returns:
      (Matrix, right-hand side (z, 1, n), wide `lid`: how far faces up into air are open).
    """
    one, width = 1.0 + 0.0 * params.drag, config.window
    liquid = (fill + phi >= 0.5).astype(fill.dtype)
    source = params.source * jnp.maximum(fill + phi - 1.0, 0.0)
    lid = wide(1.0 - params.lid * jnp.minimum(1.0, phi / 0.15), width)
    wet = wide(liquid, width)

    # What a liquid cell adds for its neighbours of air.
    here, extra = near(wet, width), 0.0
    full = wide(fill + phi, width)
    for sign in (-1, 1):
        walls = _walls(width, min(sign, 0))
        for shift, wall in zip((1, width), walls, strict=True):
            air = 1.0 - near(wet, width, sign * shift)
            air = air / _reach(near(full, width), near(full, width, sign * shift))
            extra = extra + jnp.asarray(wall, fill.dtype)[None] * air
    above, below = near(wet, width, 0, 1), near(wet, width, 0, -1)
    top = jnp.ones((config.layers, 1), fill.dtype).at[-1].set(0.0)
    bottom = jnp.ones((config.layers, 1), fill.dtype).at[0].set(0.0)
    up = (1.0 - above) * near(lid, width)
    up = up / _reach(near(full, width), near(full, width, 0, 1))
    down = (1.0 - below) * near(lid, width, 0, -1)
    down = down / _reach(near(full, width), near(full, width, 0, -1))
    open_ = top * up + bottom * down
    extra = jnp.where(here > 0.0, extra + config.ratio * open_, 1.0)
    matrix = Matrix(wet, jnp.maximum(extra, 1e-6) / one, config.ratio, width)
    rhs = (liquid * (source - divergence(face, width)))[:, None] / one
    return matrix, rhs, lid


NEAREST = 0.1
"""Share of a cell that the surface is away from a cell's middle at least."""


def _reach(here, there):
    """How far from the middle of a liquid cell the surface is on the way to one of air, where the
    fill falls to a half in between [cells]: pressure is 0 there (ghost fluid)."""
    return jnp.clip((here - 0.5) / jnp.maximum(here - there, 1e-3), NEAREST, 1.0)


def _walls(width: int, step: int = 0):
    """(n,) 1 where a face along x, and along y, `step` cells on lies inside the window."""
    return inner_x(width, width, step), inner_y(width, width, step * width)


def project(config: PaintConfig, params: PaintParams, fill, phi, face):
    """Makes the displacement volume-preserving where there is liquid.

    Overfull cells are sources; pressure is 0 in air; canvas and window sides are closed; the bed
    of hair is full of paint that cannot escape upwards for free, so faces from liquid up into air
    open only as far as there is no hair.

    Args:
      face: wide displacements.

    Returns:
      (three faces (z, n), relative residual (1,)).
    """
    width = config.window
    matrix, rhs, lid = pressure_system(config, params, fill, phi, face)
    p = solve(config.solver, matrix, rhs, config.pressure, config.spectrum)
    left = residual(matrix, p[..., width:-width], rhs)
    p = jnp.pad(p[:, 0], ((1, 1), (0, 0)))

    wet, moved, full = matrix.link, [], wide(fill + phi, width)
    here, above = near(wet, width), near(wet, width, 0, 1)
    level = near(full, width)

    def away(there, shift, layer=0):
        """1 over the distance to the surface, of whichever side of the face is liquid."""
        beyond = near(full, width, shift, layer)
        reach = jnp.where(here > 0.0, _reach(level, beyond), _reach(beyond, level))
        return jnp.where(here * there > 0.0, 1.0, 1.0 / reach)

    for f, shift, wall in zip(face[:2], (1, width), _walls(width), strict=True):
        weight = jnp.maximum(here, near(wet, width, shift))
        weight = weight * jnp.asarray(wall, fill.dtype)[None] * away(near(wet, width, shift), shift)
        drop = near(p, width, shift) - near(p, width)
        moved.append(near(f, width) - weight * drop)
    top = jnp.ones((config.layers, 1), fill.dtype).at[-1].set(0.0)
    weight = jnp.maximum(here * above, jnp.maximum(here, above) * near(lid, width)) * top
    weight = weight * away(above, 0, 1)
    drop = near(p, width, 0, 1) - near(p, width)
    moved.append(near(face[2], width) - config.ratio * weight * drop)
    return moved, left


def stop(params: PaintParams, config: PaintConfig, face, step):
    """Yield: paint that would move less than a share of the brush's travel stands still.

    A cut on the square of speed, in place of a stress: smooth above the threshold, and no root.

    Args:
      face: wide displacements. step: () travel of the brush in the stamp [mm].

    Returns:
      Wide displacements.
    """
    width = config.window
    # A brush at rest moves nothing either, and no rounding does.
    threshold = jnp.maximum(params.yield_share * step / config.pixel, 1e-4)
    square = 0.0
    for f, shift, layer in zip(face, (-1, -width, 0), (0, 0, -1), strict=True):
        scale = config.layer / config.pixel if layer else 1.0
        middle = 0.5 * scale * (near(f, width) + near(f, width, shift, layer))
        square = square + middle * middle
    keep = wide(jnp.clip(1.0 - threshold**2 / (square + 1e-12), 0.0, 1.0), width)
    ends = zip(face, (1, width, 0), (0, 0, 1), strict=True)
    return [
        wide(
            near(f, width) * jnp.maximum(near(keep, width), near(keep, width, shift, layer)), width
        )
        for f, shift, layer in ends
    ]


def flow(config: PaintConfig, params: PaintParams, fill, phi, motion, step) -> Flow:
    """Displacement of the paint in one stamp: fill, phi (z, n), motion (z, 3, n)."""
    one, width = 1.0 + 0.0 * params.drag, config.window
    u, rough = viscous(config, params, fill, phi, motion)
    face = [wide(f, width) for f in faces_of(config, u)]
    face, left = project(config, params, fill, phi, face)
    face = stop(params, config, [wide(f, width) for f in stored(face, one)], step)
    return Flow(face=stored(face, one), residual=jnp.concatenate([rough, left]))
