"""The depth-averaged tier: two films of paint a column in place of a grid, for a tenth of the cost.

The upper film is what the hair stirs, the lower one the paint under the tips. Hair, exchange with
the brush, transport and columns are the code of the 3D simulator. What differs is the flow: a film
of thickness h over one of thickness b that sticks to the canvas, driven along by drag d of the
hair and sheared by its own viscosity, moves against a friction of 1 / (h b + h^2 / 3) on its mean
speed (a lubrication film under a uniform force); and where the bed of hair is closed above it, it
is pressed sideways (Hele-Shaw).

A film is one layer of 1 mm: amounts are thicknesses [mm], and `empty_canvas`, `volume`, `height`
and `flatten` read a canvas as they read one of the 3D simulator.
"""

import dataclasses

import jax
import jax.numpy as jnp

from jaxbrush.paint.advection import advect, repack
from jaxbrush.paint.hair import Hair, corners
from jaxbrush.paint.rollout import paint_stroke
from jaxbrush.paint.solvers import Matrix, residual, solve
from jaxbrush.paint.state import BrushPaint, PaintConfig, PaintParams, relaxation
from jaxbrush.paint.stencil import inner_x, inner_y, near, stored, wide
from jaxbrush.paint.transfer import columns, refill, ride, transfer
from jaxbrush.paint.velocity import stop

STIRRED = 0.06
"""Thickness that the hair stirs at least [mm]."""
BED = 0.3
"""Depth of the bed of hair, over which its volume closes the surface [mm]."""
PRESS = 4.0
"""Rate at which the bed presses out what stands above it [1/mm]."""
THIN = 1e-4
"""Film that counts as none for what divides by it [mm]."""


def heightfield_config(**changes) -> PaintConfig:
    """The settings of the height field; `changes` by name."""
    values = dict(
        layers=2, layer=1.0, samples=3, viscous=4, pressure=8, solver="chebyshev", spectrum=0.9
    )
    return PaintConfig(**(values | changes))


def splat(config: PaintConfig, params: PaintParams, points: Hair, z, film):
    """Hair in the paint of each column.

    Args:
      z: (s, b) heights of the points after riding up [mm]. film: (s, b) paint under them [mm].

    Returns:
      (volume (n,) of hair over the column's area [mm]; motion (2, n) mean along x, y [cells];
      bed (n,) mean height of that hair [mm]).
    """
    size = config.window
    place = jnp.stack([points.place[0], points.place[1], z * 0.0]) / config.pixel - 0.5
    place = place.at[2].set(0.0)
    index, share = corners(config, place.reshape(3, -1), (1, size, size))
    index, share = index[:4], share[:4]
    dipped = jnp.clip((film - z) / (2.0 * params.hair_radius) + 0.5, 0.0, 1.0)
    mass = (points.volume * dipped).reshape(-1) / config.pixel**2
    motion = points.motion[:2].reshape(2, -1) / config.pixel
    rows = jnp.stack([mass, mass * motion[0], mass * motion[1], mass * z.reshape(-1)])
    # (4, 4, n) into (4, y x)
    number = jnp.arange(4, dtype=jnp.int32)[:, None, None] * size**2 + index[None]
    total = jnp.zeros(4 * size**2, z.dtype).at[number].add(rows[:, None] * share[None])
    total = total.reshape(4, -1)
    # A hair parts the paint beside it too; without this, single pixels between hairs stand up.
    for shift, inside in ((1, inner_x), (size, inner_y)):
        field = wide(total, size)
        for side in (shift, -shift):
            open_ = jnp.asarray(inside(size, size, min(side, 0)), z.dtype)[None]
            total = total + 0.25 * open_ * (near(field, size, side) - near(field, size))
    mean = total[1:] / jnp.maximum(total[:1], 1e-9)
    return total[0], mean[:2], mean[2]


def _split(film, bed, hairy):
    """Thickness of paint under what the hair stirs, (n,) [mm]."""
    return jnp.clip(jnp.minimum(film - STIRRED, bed), 0.0, None) * hairy


def drag_flow(config: PaintConfig, params: PaintParams, top, under, hairs, motion):
    """Quasi-steady mean displacement of the upper film.

    Solves h (d + 1 / m) u - div(h grad u) = h d u_hair, m = h b + h^2 / 3: drag of the hair,
    friction on the canvas through the film below, and viscous stress between columns.

    Args:
      top, under: (n,) thickness h of the upper film and b of the one below [mm].
      hairs: (n,) volume of hair over area [mm]. motion: (2, n) of the hair [cells].

    Returns:
      (u (2, n) [cells]; resistance (n,) d + 1 / m, per cell; residual (2,)).
    """
    size, one = config.window, 1.0 + 0.0 * params.drag
    thick = jnp.maximum(top, THIN)
    phi = jnp.minimum(hairs / jnp.maximum(top, params.hair_radius), 0.5)
    drag = params.drag * phi * config.pixel**2
    slip = thick * (under + thick / 3.0)
    resistance = (drag + config.pixel**2 / slip) / one
    matrix = Matrix(wide(top[None], size), (resistance * thick)[None] / one, 1.0, size)
    rhs = (thick * drag)[None, None] * motion[None] / one
    u = solve("chebyshev", matrix, rhs, config.viscous, config.spectrum)
    return u, resistance, residual(matrix, u[..., size:-size], rhs)


def press(config: PaintConfig, params: PaintParams, top, hairs, resistance, over, face):
    """Displacement after the pressure under the bed of hair.

    Paint that gathers in a column rises, past hair that stops the share `lid` of it, over half the
    film's thickness; what cannot, flows to the sides against the same resistance:
    div(q - M grad p) = -rise p, M = h / resistance, rise = 2 open / (h resistance).

    Args:
      face: two wide displacements of the upper film, (3, n + 2 width) [cells].

    Returns:
      (two faces (1, n) [cells], residual (1,)).
    """
    size, one = config.window, 1.0 + 0.0 * params.drag
    thick = jnp.maximum(top, THIN)
    film = wide(top[None], size)
    steps = ((1, inner_x(size, size)), (size, inner_y(size, size)))
    gather, flux = params.source * over[None], []
    for f, (shift, _) in zip(face, steps, strict=True):
        here = near(f, size)
        flux.append(here * jnp.where(here > 0.0, near(film, size), near(film, size, shift)))
        leaving = wide(flux[-1], size)
        gather = gather + near(leaving, size, -shift) - near(leaving, size)
    mobile = wide((top / resistance)[None], size)
    open_ = 1.0 - params.lid * jnp.minimum(1.0, hairs / (0.15 * BED))
    rise = 2.0 * open_ * config.pixel**2 / (thick * resistance) + 1e-9
    matrix = Matrix(mobile, rise[None] / one, 1.0, size)
    rhs = gather[:, None] / one
    p = solve(config.solver, matrix, rhs, config.pressure, config.spectrum)
    left = residual(matrix, p[..., size:-size], rhs)
    p = jnp.pad(p[:, 0], ((1, 1), (0, 0)))
    moved = []
    for f, (shift, inner) in zip(flux, steps, strict=True):
        drop = near(p, size) - near(p, size, shift)
        link = jnp.minimum(near(mobile, size), near(mobile, size, shift))
        f = f + link * drop * jnp.asarray(inner, top.dtype)[None]
        film_of = jnp.where(f > 0.0, near(film, size), near(film, size, shift))
        moved.append(f / jnp.maximum(film_of, THIN))
    return moved, left


def fall(config: PaintConfig, params: PaintParams, top, surface, hairy, step):
    """Displacement of the upper film where steep steps of the surface fall near the hair.

    Returns:
      Two faces (1, n) [cells].
    """
    size = config.window
    high, film, close = (wide(a[None], size) for a in (surface, top, hairy))
    rate, stands = relaxation(config, params, step)
    faces = []
    for shift, inner in ((1, inner_x(size, size)), (size, inner_y(size, size))):
        drop = near(high, size) - near(high, size, shift)
        beyond = jnp.maximum(jnp.abs(drop) - stands, 0.0)
        beyond = beyond * jnp.asarray(inner, top.dtype)[None]
        beyond = beyond * jnp.maximum(near(close, size), near(close, size, shift))
        giver = jnp.where(drop > 0.0, near(film, size), near(film, size, shift))
        faces.append(rate * beyond * jnp.sign(drop) / jnp.maximum(giver, THIN))
    return faces


def stamp(config: PaintConfig, params: PaintParams, paint, brush: BrushPaint, points, cloth):
    """One stamp on a window.

    Args:
      paint: (2, k, y, x) [mm]. points: Hair relative to the window. cloth: (2, y, x) heights of the
        weave and of its threads [mm].

    Returns:
      (paint, brush, residual (4,): two viscous solves, 0, and the pressure).
    """
    one, size, shape = 1.0 + 0.0 * points.step, config.window, paint.shape
    z, film = ride(config, params, paint, points)
    hairs, motion, bed = stored(splat(config, params, points, z, film), one)
    wet = (hairs > 0.0).astype(paint.dtype)

    # The hair stirs what lies above its mean height; columns without hair keep their films.
    paint = paint.reshape(2, config.pigments, -1)
    films = jnp.sum(paint, axis=1)
    below = _split(films[0] + films[1], bed, wet) + (1.0 - wet) * films[0]
    paint = stored(repack(paint, jnp.stack([below, jnp.full_like(below, 1e6)])), one)

    # Exchange is with the upper film, so heights count from the lower one.
    under = jnp.sum(paint[0], axis=0).reshape(size, size)
    raised = points.place.at[2].set(z - columns(config, under, points.place))
    top, brush = transfer(
        config,
        dataclasses.replace(params, compliance=0.0 * params.compliance),
        paint[1:].reshape(1, *shape[1:]),
        brush,
        dataclasses.replace(points, place=raised),
        jnp.maximum(cloth - under[None], 0.0),
    )
    top = top.reshape(1, config.pigments, -1)
    paint = stored(jnp.concatenate([paint[:1], top]), one)
    brush = refill(config, params, brush, points.travel)

    films = stored(jnp.sum(paint, axis=1), one)
    under, top = films[0], films[1]
    u, resistance, rough = drag_flow(config, params, top, under, hairs, motion)
    face = []
    for k, (shift, inner) in enumerate(((1, inner_x(size, size)), (size, inner_y(size, size)))):
        mean = 0.5 * (u[:, k, size:-size] + u[:, k, size + shift : u.shape[2] - size + shift])
        face.append(wide(mean * jnp.asarray(inner, u.dtype)[None], size))
    held = jnp.sum(brush.tip) / params.tip_volume
    coat = params.hair_radius * (params.coat_dry + params.coat_full * jnp.minimum(held, 1.3))
    ceiling = jnp.maximum(bed + 0.7 * coat - params.hair_radius, 0.0)
    over = jnp.maximum(under + top - ceiling, 0.0) * wet
    over = (1.0 - jnp.exp(-PRESS * points.step)) * over
    face, left = press(config, params, top, hairs, resistance, over, face)
    still = jnp.zeros((3, size * size + 2 * size), u.dtype)
    face = stop(params, config, [*(wide(f, size) for f in face), still], points.step)
    # The film below is sheared: at rest on the canvas, half the interface's speed on average.
    follows = wide((0.5 * under / (under + top / 3.0 + THIN))[None], size)
    near_hair = jax.lax.reduce_window(
        wet.reshape(size, size), jnp.zeros((), wet.dtype), jax.lax.max, (5, 5), (1, 1), "SAME"
    )
    slide = fall(config, params, top, under + top, near_hair.reshape(-1), points.step)
    both = []
    for f, s, shift in zip(face[:2], slide, (1, size), strict=True):
        lower = 0.5 * (near(follows, size) + near(follows, size, shift)) * near(f, size)
        both.append(wide(jnp.concatenate([lower, near(f, size) + s]), size))
    still = jnp.zeros((4, size * size + 2 * size), u.dtype)
    paint = advect(config, paint, [*both, still], params.bound)
    return paint.reshape(shape), brush, jnp.concatenate([rough, 0.0 * left, left])


def heightfield_stroke(
    config: PaintConfig, params: PaintParams, canvas, brush: BrushPaint, track, tooth=None
):
    """Paints one stroke with two films a column; see `paint_stroke`, whose arguments it takes.

    Args:
      config: of `heightfield_config`. canvas: (2, k, y, x) thickness of each pigment in the lower
      and the upper film [mm].

    Returns:
      (canvas, brush, PaintReport), `fullest` being the thickest lower film [mm].

    Raises:
      ValueError: shapes that do not fit.
    """
    if (config.layers, config.layer) != (2, 1.0):
        raise ValueError(
            f"config of {config.layers} layers of {config.layer} mm: expected 2 films of 1.0 mm"
        )
    return paint_stroke(config, params, canvas, brush, track, tooth, stamp)
