"""A stroke of paint: bristle track and loaded brush in, painted canvas out, in one scan."""

import jax
import jax.numpy as jnp

from jaxbrush.paint.advection import advect, repack, slump
from jaxbrush.paint.hair import hair
from jaxbrush.paint.state import BrushPaint, PaintConfig, PaintParams
from jaxbrush.paint.stencil import stored
from jaxbrush.paint.transfer import refill, ride, threads, transfer
from jaxbrush.paint.velocity import flow, splat
from jaxbrush.structs import state


@state
class PaintReport:
    """What a stroke did, by stamp. residual: (t, 4) of the viscous solves and the pressure.
    fullest: (t,) largest fill of a cell; above 1 only in the top layer. reached: (t,) whether all
    bristles low over the canvas were inside the window."""

    residual: jax.Array
    fullest: jax.Array
    reached: jax.Array


def _near(field, cells: int):
    """Maximum over a square of `cells` around each column."""
    window = 2 * cells + 1
    return jax.lax.reduce_window(
        field, jnp.zeros((), field.dtype), jax.lax.max, (window, window), (1, 1), "SAME"
    )


def stamp(config: PaintConfig, params: PaintParams, paint, brush: BrushPaint, points, cloth):
    """One stamp on a window.

    Args:
      paint: (z, k, y, x). points: Hair relative to the window. cloth: (2, y, x) heights of the
        weave and of its `threads` [mm].

    Returns:
      (paint, brush, residual (4,)).
    """
    one = 1.0 + 0.0 * points.step
    shape = paint.shape
    paint, brush = transfer(config, params, paint, brush, points, cloth)
    paint = stored(paint, one)
    brush = refill(config, params, brush, points.travel)
    z, _ = ride(config, params, paint, points)
    phi, motion = stored(splat(config, points, z), one)
    paint = paint.reshape(*shape[:2], -1)
    hairy = jnp.minimum(jnp.sum(phi, axis=0) / 0.02, 1.0).reshape(shape[2:])
    paint = slump(config, params, paint, _near(hairy, 2).reshape(-1), points.step)
    paint = stored(paint, one)
    fill = stored(jnp.sum(paint, axis=1), one)
    moved = flow(config, params, fill, phi, motion, points.step)
    paint = stored(advect(config, paint, moved.face, params.bound), one)
    paint = repack(paint, 1.0 - phi)
    return paint.reshape(shape), brush, moved.residual


def paint_stroke(
    config: PaintConfig, params: PaintParams, canvas, brush: BrushPaint, track, tooth=None,
    stamp=stamp,
):  # fmt: skip
    """Paints one stroke.

    A pure function. Only a window around the brush is touched; the rest of the canvas stays
    bit-identical and costs nothing. Stamps should be at most a pixel apart.

    Args:
      canvas: (z, k, y, x) pigment amounts. brush: paint of b bristles.
      track: BristleTrack of t stamps, with at least 2 nodes, on the same canvas coordinates [mm].
      tooth: (y, x) height of the weave [mm], or None for a smooth canvas.
      stamp: what a stamp does on a window, with the arguments of `stamp`.

    Returns:
      (canvas, brush, PaintReport).

    Raises:
      ValueError: shapes that do not fit.
    """
    layers, k, h, w = canvas.shape
    if (k, layers) != (config.pigments, config.layers) or min(h, w) < config.window:
        raise ValueError(
            f"canvas has shape {canvas.shape}: expected ({config.layers}, {config.pigments}, y, x) "
            f"with y, x >= config.window = {config.window}"
        )
    b = track.position.shape[-1]
    if track.position.shape[1] < 2 or brush.tip.shape != (k, b):
        raise ValueError(
            f"track of {track.position.shape[1]} nodes and {b} bristles, brush.tip of shape "
            f"{brush.tip.shape}: expected at least 2 nodes and {(k, b)}"
        )
    if tooth is None:
        cloth = jnp.zeros((2, h, w), canvas.dtype)
    else:
        cloth = jnp.stack([tooth, threads(config, tooth)])
    nodes = track.position[:, -2:].astype(canvas.dtype)
    # (t, 3, 2, b) with the tip last on the third axis
    nodes = jnp.swapaxes(nodes, 1, 2)
    before = jnp.concatenate([nodes[:1], nodes[:-1]])
    dt = jnp.concatenate([track.time[:1] * 0.0, track.time[1:] - track.time[:-1]])
    size = config.window
    middle = jnp.mean(nodes[:, :2, 1], axis=-1) / config.pixel
    corner = jnp.round(middle - 0.5 * size)
    corner = jnp.stack(
        [jnp.clip(corner[:, 1], 0, h - size), jnp.clip(corner[:, 0], 0, w - size)], axis=1
    ).astype(jnp.int32)

    def body(carry, inputs):
        canvas, brush = carry
        a, b, dt, at, valid = inputs
        y, x = at[0], at[1]
        offset = jnp.stack([x, y, jnp.zeros_like(x)]).astype(canvas.dtype) * config.pixel
        local = lambda n: jnp.swapaxes(n - offset[:, None, None], 0, 1)  # noqa: E731
        active = jnp.where(valid, jnp.ones(b.shape[-1], canvas.dtype), 0.0)
        points = hair(config, params, local(a), local(b), dt, active)
        window = jax.lax.dynamic_slice(canvas, (0, 0, y, x), (layers, k, size, size))
        under = jax.lax.dynamic_slice(cloth, (0, y, x), (2, size, size))
        # Padding costs nothing. (Under vmap both branches run, and the right one is taken.)
        painted, wet, residual = jax.lax.cond(
            valid,
            lambda: stamp(config, params, window, brush, points, under),
            lambda: (window, brush, jnp.zeros(4, window.dtype)),
        )
        canvas = jax.lax.dynamic_update_slice(canvas, painted, (0, 0, y, x))
        # Hair over the canvas's edge is not missed.
        tip = local(b)[1]
        edge = jnp.asarray([w, h], canvas.dtype) * config.pixel - offset[:2]
        there = jnp.all((tip[:2] >= -offset[:2, None]) & (tip[:2] <= edge[:, None]), axis=0)
        seen = jnp.all((tip[:2] >= 0.0) & (tip[:2] <= size * config.pixel), axis=0)
        missed = jnp.any(there & ~seen & (tip[2] < config.layer * layers))
        fullest = jnp.max(jnp.sum(painted[:-1], axis=1))
        return (canvas, wet), (residual, fullest, ~missed | ~valid)

    (canvas, brush), seen = jax.lax.scan(
        body, (canvas, brush), (before, nodes, dt, corner, track.valid)
    )
    return canvas, brush, PaintReport(*seen)
