"""Which pairs an update sees, and how they are changed on the way: mirrored, turned, recolored."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from experiments.evaluation import Pairs
from jaxbrush.batches import recolored


@functools.lru_cache(maxsize=2)
def _order(seed: int, epoch: int, count: int) -> np.ndarray:
    return np.random.default_rng((seed, epoch)).permutation(count)


def indices(seed: int, step: int, size: int, count: int) -> np.ndarray:
    """Numbers of the pairs that update `step` sees: a pure function, so that a resumed run sees
    the same ones. Every pair once before any comes again."""
    at = range(step * size, (step + 1) * size)
    return np.array([_order(seed, p // count, count)[p % count] for p in at], np.int32)


def turned(batch, which):
    """A batch (n, h, w, c) of square pictures, mirrored and turned: one of 8 ways."""
    flips = [lambda x: x, lambda x: jnp.flip(x, 1), lambda x: jnp.flip(x, 2),
             lambda x: jnp.flip(x, (1, 2))]  # fmt: skip
    ways = flips + [lambda x, f=f: f(jnp.swapaxes(x, 1, 2)) for f in flips]
    every = [lambda b, w=w: jax.tree.map(w, b) for w in ways]
    return jax.lax.switch(which, every, batch)


def mixes(options, kind: str) -> bool:
    """Whether the network that the options (`training.Options`) ask for mixes colors."""
    return kind != "height" and options.mixes


RECOLOR = 0.7
"""Largest change of the logarithm of absorption over scattering, in each channel."""


SOME = 64
"""Pairs that are made at once."""


def every(pairs: Pairs):
    """All pairs on the host, `SOME` at a time: what they are made from is as large again."""
    count = len(pairs)
    whole = jax.tree.map(
        lambda x: np.empty((count, *x.shape[1:]), x.dtype), pairs.take(np.arange(1))
    )
    for first in range(0, count, SOME):
        index = np.arange(first, min(first + SOME, count))
        for into, some in zip(*map(jax.tree.leaves, (whole, pairs.take(index))), strict=True):
            into[index] = some
    return whole


def make_batches(pairs: Pairs, options, kind: str = "height"):
    """`batches(step) -> (Batch on the device, numbers of its pairs)`, as `training.Options` ask;
    the same whether all pairs are on the device or not."""
    device = jax.devices()[0]
    resident = pairs.nbytes <= options.resident * 1e9
    data = jax.device_put(every(pairs), device) if resident else None
    gather = jax.jit(lambda data, index: jax.tree.map(lambda x: x[index], data))
    # The paint knows no direction, so every pair is worth eight.
    turn = jax.jit(turned)
    change = jax.jit(recolored)
    recolor = kind != "height" and options.recolor and not mixes(options, kind)

    def batches(step: int):
        index = indices(options.seed, step, options.batch, len(pairs))
        if resident:
            found = gather(data, jax.device_put(index, device))
        else:
            found = jax.device_put(pairs.take(index), device)
        if options.turns:
            which = np.random.default_rng((options.seed, step)).integers(8)
            found = turn(found, jax.device_put(np.int32(which), device))
        if recolor:
            draw = np.random.default_rng((options.seed, step, 1))
            channels = draw.permutation(3).astype(np.int32)
            scale = np.exp(draw.uniform(-RECOLOR, RECOLOR, 3)).astype(np.float32)
            found = change(found, *jax.device_put((channels, scale), device))
        return found, index

    return batches
