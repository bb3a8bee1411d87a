"""How unlike the maps of two strokes are, coarsely or finely: what a fit descends."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.raster import Grid, trajectory_maps
from jaxbrush.structs import config, state

PIXEL = 0.1
"""Side of a pixel of the maps that are read [mm]."""


@config
class Level:
    """How the maps are compared for some steps.

    pixel: side [mm], and the edge of the soft maps. waves: time enters as that many turns of a
    clock hand over the stroke. rate: learning rate at start and end [mm]. shares: factors on the
    rate for each scale of the unknown.
    """

    pixel: float
    waves: tuple[float, float]
    steps: int
    rate: tuple[float, float]
    shares: tuple[float, ...]


def clock(maps):
    """Time (h, w) in [0, 1] of a map."""
    touched = maps.coverage > 1e-3
    return jnp.where(touched, maps.time / jnp.where(touched, maps.coverage, 1.0), 0.0)


def features(maps, waves):
    """Images that are compared, (6, h, w): coverage, pressure, and coverage times the hand of a
    clock that goes round `waves` (2,) times in a stroke: bounded at crossings, where time jumps."""
    angle = 2 * np.pi * waves[:, None, None] * clock(maps)[None]
    hands = jnp.concatenate([jnp.cos(angle), jnp.sin(angle)]) * maps.coverage[None]
    return jnp.concatenate([jnp.stack([maps.coverage, 2.0 * maps.pressure]), hands])


def coarse(exact, waves, shape):
    """Features of exact maps, averaged over the larger pixels of a grid of `shape`."""
    rows = features(exact, waves)
    (c, h, w), (down, across) = rows.shape, shape
    return jnp.mean(rows.reshape(c, down, h // down, across, w // across), axis=(2, 4))


@state
class Target:
    """What a level compares with: images (6, h, w), made with `waves` (2,)."""

    images: jax.Array
    waves: jax.Array


def target_of(level: Level, exact) -> Target:
    """What a level is compared with, from the exact maps."""
    waves = jnp.asarray(level.waves, float)
    shape = tuple(round(n * PIXEL / level.pixel) for n in exact.coverage.shape)
    return Target(images=coarse(exact, waves, shape), waves=waves)


def unlike(images, target: Target):
    """Squared difference of images (6, h, w) from a target, relative."""
    return jnp.sum((images - target.images) ** 2) / jnp.sum(target.images**2)


@jax.jit
def unlike_exact(maps, target: Target):
    """The same of exact maps."""
    return unlike(coarse(maps, target.waves, target.images.shape[1:]), target)


def compare(pixel: float, longest: float, origin, target: Target, track):
    """Loss of a track against a target, and whether its maps are whole.

    Its value is that of the exact maps, its slope that of the soft ones: these are wider by their
    edge, and their own match lies 0.1 mm off.
    """
    shape = target.images.shape[1:]
    soft = trajectory_maps(
        Grid(shape=shape, origin=origin, pixel=pixel), track, edge=pixel, longest=longest
    )
    drawn = features(soft, target.waves)
    fine = tuple(round(n * pixel / PIXEL) for n in shape)
    exact = trajectory_maps(Grid(shape=fine, origin=origin, pixel=PIXEL), track)
    true = coarse(jax.lax.stop_gradient(exact), target.waves, shape)
    images = drawn + jax.lax.stop_gradient(true - drawn)
    return unlike(images, target), soft.whole
