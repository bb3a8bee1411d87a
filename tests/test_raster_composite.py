"""Windows laid over an image one after the other: against a plain scan, and what slopes cost."""

import time

import jax
import jax.numpy as jnp
import numpy as np
from jax.test_util import check_grads

from jaxbrush.raster import soft


def scan_composite(image, keep, add, color, earlier, corner, order):
    """The same as `soft.composite`, plainly: jax differentiates it by itself."""
    side = keep.shape[-1]

    def body(image, window):
        keep, add, color, earlier, corner = window
        start = (jnp.zeros((), corner.dtype), corner[0], corner[1])
        old = jax.lax.dynamic_slice(image, start, (6, side, side))
        paint = color[:, None, None] * add[:1] + earlier[:, None, None] * add[1:2]
        new = old * keep[None] + jnp.concatenate([add[:1] + add[1:2], add[2:], paint])
        return jax.lax.dynamic_update_slice(image, new, start), None

    windows = jax.tree.map(lambda x: x[order], (keep, add, color, earlier, corner))
    return jax.lax.scan(body, image, windows)[0]


def windows(count=12, size=10, side=4):
    rng = np.random.default_rng(3)
    values = (
        rng.normal(size=(6, size, size + 1)),
        rng.uniform(size=(count, side, side)),
        rng.normal(size=(count, 4, side, side)),
        rng.normal(size=(count, 3)),
        rng.normal(size=(count, 3)),
    )
    corner = jnp.asarray(rng.integers(0, size - side + 1, (count, 2)), jnp.int32)
    order = jnp.asarray(rng.permutation(count), jnp.int32)
    return *(jnp.asarray(value) for value in values), corner, order


def test_composite_is_the_plain_scan(x64):
    *values, corner, order = windows()
    weight = jnp.asarray(np.random.default_rng(0).normal(size=values[0].shape))

    def slopes(composite):
        total = lambda *v: jnp.sum(weight * jnp.sin(composite(*v, corner, order)))  # noqa: E731
        return jax.jit(jax.value_and_grad(total, (0, 1, 2, 3, 4)))(*values)

    ours, plain = slopes(soft.composite), slopes(scan_composite)
    assert len(np.unique(np.asarray(corner), axis=0)) > 8
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
    run = jax.jit(lambda *v: soft.composite(*v, corner, order))
    check_grads(run, values, 1, modes=["rev"], rtol=1e-6)


def test_cost_of_the_slope_is_that_of_the_windows():
    # Failure: by autodiff, each window adds a whole image to the slope of the image.
    count, side, small, large = 100, 4, 32, 256
    rng = np.random.default_rng(0)
    shapes = (count, side, side), (count, 4, side, side), (count, 3), (count, 3)
    values = [jnp.asarray(rng.uniform(size=shape), jnp.float32) for shape in shapes]
    corner = jnp.asarray(rng.integers(0, small - side, (count, 2)), jnp.int32)
    order = jnp.asarray(rng.permutation(count), jnp.int32)

    def cost(composite, size):
        """(temporary memory in images, seconds) of a slope."""
        total = lambda *v: jnp.sum(composite(*v) ** 2)  # noqa: E731
        image = jnp.zeros((6, size, size))
        run = jax.jit(jax.grad(total, (1, 2, 3, 4))).lower(image, *values, corner, order).compile()
        took = []
        for _ in range(5):
            start = time.perf_counter()
            jax.block_until_ready(run(image, *values, corner, order))
            took.append(time.perf_counter() - start)
        return run.memory_analysis().temp_size_in_bytes, min(took)

    ours, plain = cost(soft.composite, large), cost(scan_composite, large)
    grown = (ours[0] - cost(soft.composite, small)[0]) / (6 * 4 * (large**2 - small**2))
    print(f"slope of {count} windows: memory +{grown:.1f} images, {ours[1] * 1e3:.1f} ms, "
          f"by autodiff {plain[1] * 1e3:.1f} ms")  # fmt: skip
    assert grown < 6.0, "memory grows with the image times something"
    assert plain[1] > 3.0 * ours[1]
