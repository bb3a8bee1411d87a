"""Planes that know their neighbours: how the simulator reads the cell next to a cell, fast.

Fields of the window are kept as flat planes, (z, ..., y * x). `wide` adds margins of zeros, one
plane above and below and one row before and after, and a neighbour is then the same array read
from another start. Each read must be a slice of its own of a stored array: XLA's CPU back end
calls a function for every element of a computed array that is read at two offsets (7 times the
time, JAX 0.10).
"""

import jax
import jax.numpy as jnp
import numpy as np


def stored(tree, one):
    """The same values, as arrays that XLA keeps instead of working them out again for each reader:
    it never repeats a division. (The CPU back end drops `optimization_barrier`.)

    Args:
      one: () traced 1.0.
    """
    return jax.tree.map(lambda x: x / one, tree)


def wide(planes, width: int):
    """(z, ..., n) to (z + 2, ..., n + 2 width), zeros around.

    Values that took work should be `stored` before: XLA may make padding of this and fuse it.
    """
    layers, *parts, n = planes.shape
    zeros = jnp.zeros((layers + 2, *parts, n + 2 * width), planes.dtype)
    return jax.lax.dynamic_update_slice(zeros, planes, (1, *[0] * len(parts), width))


def near(planes, width: int, shift: int = 0, layer: int = 0):
    """Planes (z, ..., n) of `wide` planes, `shift` cells on and `layer` layers up."""
    start = [1 + layer] + [0] * (planes.ndim - 2) + [width + shift]
    stop = [planes.shape[0] - 1 + layer, *planes.shape[1:-1], planes.shape[-1] - width + shift]
    return jax.lax.slice(planes, start, stop)


def inner_x(height: int, width: int, shift: int = 0) -> np.ndarray:
    """(n,) 1 where cell + `shift` has a next cell along x in its row."""
    mask = np.ones((height, width), np.float32)
    mask[:, -1] = 0.0
    mask = np.pad(mask.reshape(-1), width)
    return mask[width + shift : width + shift + height * width]


def inner_y(height: int, width: int, shift: int = 0) -> np.ndarray:
    """(n,) 1 where cell + `shift` has a next cell along y."""
    mask = np.ones(height * width, np.float32)
    mask[-width:] = 0.0
    mask = np.pad(mask, width)
    return mask[width + shift : width + shift + height * width]
