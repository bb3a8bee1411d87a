"""How unlike the maps of two strokes are, coarsely or finely: what a fit descends."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.raster import Grid, trajectory_maps
from jaxbrush.structs import config, state

PIXEL = 0.1
"""Side of a pixel of the maps that are read [mm]."""
BINS = 17
"""Parts of a stroke's time whose centre, area and force are compared at the coarse levels."""


@config
class Level:
    """How the maps are compared for some steps.

    pixel: side [mm]. edge: of soft coverage [mm]. blur: standard deviation of the blur that both
    sides get [mm]. waves: time enters as that many turns of a clock hand over the stroke. weights:
    of images and of moments in the loss. rate: learning rate at start and end [mm]. path, press:
    factors on the rate for each scale of the unknown.
    """

    pixel: float
    edge: float
    blur: float
    waves: tuple[float, float]
    weights: tuple[float, float]
    steps: int
    rate: tuple[float, float]
    path: tuple[float, ...]
    press: tuple[float, ...]


def _clock(maps):
    """Time (h, w) in [0, 1] of a map."""
    touched = maps.coverage > 1e-3
    return jnp.where(touched, maps.time / jnp.where(touched, maps.coverage, 1.0), 0.0)


def features(maps, waves):
    """Images that are compared, (6, h, w): coverage, pressure, and coverage times the hand of a
    clock that goes round `waves` (2,) times in a stroke: bounded at crossings, where time jumps."""
    angle = 2 * np.pi * waves[:, None, None] * _clock(maps)[None]
    hands = jnp.concatenate([jnp.cos(angle), jnp.sin(angle)]) * maps.coverage[None]
    return jnp.concatenate([jnp.stack([maps.coverage, 2.0 * maps.pressure]), hands])


def moments(maps, pixel: float):
    """What was touched last in each part of the stroke's time, (BINS, 4): its centre x, y [mm],
    its mean pressure and its area [mm^2]. Tells where the brush was from any distance."""
    h, w = maps.coverage.shape
    time = _clock(maps)
    at = jnp.arange(BINS, dtype=time.dtype)[:, None, None]
    share = jnp.clip(1.0 - jnp.abs(time[None] * (BINS - 1) - at), 0.0, 1.0) * pixel**2
    x = (jnp.arange(w, dtype=time.dtype) + 0.5 - w / 2) * pixel
    y = (jnp.arange(h, dtype=time.dtype) + 0.5 - h / 2) * pixel
    cover = share * maps.coverage[None]
    area = jnp.sum(cover, axis=(1, 2))
    per = 1.0 / (area + 1e-2)
    across = jnp.matmul(jnp.sum(cover, axis=1), x, precision="highest") * per
    down = jnp.matmul(jnp.sum(cover, axis=2), y, precision="highest") * per
    force = jnp.sum(share * maps.pressure[None], axis=(1, 2)) * per
    return jnp.stack([across, down, force, area], axis=1)


def _blurring(size: int, sigma: float):
    """Matrix (size, size) that blurs by a Gaussian of sigma [pixels], or None."""
    if sigma == 0.0:
        return None
    index = np.arange(size)
    kernel = np.exp(-0.5 * ((index[:, None] - index[None]) / sigma) ** 2)
    return jnp.asarray(kernel / (sigma * np.sqrt(2.0 * np.pi)), float)


def _blurred(images, kernel):
    if kernel is None:
        return images
    return jnp.einsum("yv,cvu,xu->cyx", kernel, images, kernel, precision="highest")


@state
class Target:
    """What a level compares with; the weights of its loss. kernel: of the blur, or None."""

    images: jax.Array
    moments: jax.Array
    waves: jax.Array
    kernel: jax.Array | None
    weights: jax.Array


def target_of(level: Level, exact) -> Target:
    """What a level is compared with, from the exact maps: features averaged over its pixels."""
    waves = jnp.asarray(level.waves, float)
    rows = features(exact, waves)
    k = round(level.pixel / PIXEL)
    c, h, w = rows.shape
    rows = jnp.mean(rows.reshape(c, h // k, k, w // k, k), axis=(2, 4))
    kernel = _blurring(h // k, level.blur / level.pixel)
    return Target(
        images=_blurred(rows, kernel),
        moments=moments(exact, PIXEL),
        waves=waves,
        kernel=kernel,
        weights=jnp.asarray(level.weights, float),
    )


def compare(pixel: float, edge: float, longest: float, origin, target: Target, track):
    """Loss of a track against a target, and whether its maps are whole."""
    grid = Grid(shape=target.images.shape[1:], origin=origin, pixel=pixel)
    maps = trajectory_maps(grid, track, edge=edge, longest=longest)
    images = _blurred(features(maps, target.waves), target.kernel)
    unlike = jnp.sum((images - target.images) ** 2) / jnp.sum(target.images**2)
    now, then = moments(maps, pixel), target.moments
    # A part that others painted over says little.
    trust = jnp.minimum(now[:, 3], then[:, 3])
    trust = jax.lax.stop_gradient(trust / (trust + 1.0))
    scale = jnp.asarray([[0.1, 0.1, 3.0]], now.dtype)
    apart = trust * jnp.sum(scale * (now - then)[:, :3] ** 2, axis=1)
    area = jnp.log((now[:, 3] + 1.0) / (then[:, 3] + 1.0))
    apart = jnp.mean(apart + 0.1 * area**2)
    return target.weights[0] * unlike + target.weights[1] * apart, maps.whole
