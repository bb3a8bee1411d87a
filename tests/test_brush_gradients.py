"""Gradients through a stroke: right, and finite where lengths, forces or angles vanish."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbrush.brush import BrushConfig, explicit, implicit, make_brush, rollout
from jaxbrush.brush.forces import elastic_force, tension
from jaxbrush.brush.handle import Pose
from jaxbrush.stylus import make_stroke, pad, resample

FAST = ("quasi_static", "projective", "implicit_euler")


def drag(count=16, speed=60.0, dt=0.003, **values):
    t = dt * np.arange(count)
    path = np.stack([speed * t, 0.3 * speed * t], 1)
    default = {"pressure": 0.4, "altitude": 1.1, "azimuth": 2.8}
    return make_stroke(path, t, **(default | values))


def brush(key, integrator, bristles=2, iterations=1, **values):
    config = BrushConfig(
        nodes=4, integrator=integrator, contact_nodes=1, approach=4, iterations=iterations
    )
    return config, make_brush(key, config, "flat", bristles, **values)


def loss(track):
    return jnp.sum(jnp.sin(0.3 * track.position[-6:])) + 1e-4 * jnp.sum(track.force[-6:])


def changed(params, stroke, x):
    """The stroke moved by a bump, pressed more, of a brush that is stiffer: x (3,)."""
    bump = jnp.sin(jnp.linspace(0.0, 4.0, stroke.time.shape[0]).astype(x.dtype))
    stroke = dataclasses.replace(
        stroke,
        position=stroke.position + x[0] * jnp.stack([bump, -bump], axis=1),
        pressure=stroke.pressure + x[1],
    )
    return dataclasses.replace(params, bending=params.bending * (1.0 + x[2])), stroke


def assert_finite(tree):
    for leaf in jax.tree.leaves(tree):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            assert np.all(np.isfinite(np.asarray(leaf)))


@pytest.mark.slow
@pytest.mark.parametrize("integrator", FAST)
def test_gradient_is_the_finite_difference(x64, key, integrator):
    config, params = brush(key, integrator)

    @jax.jit
    def f(x):
        return loss(rollout(config, *changed(params, drag(), x)))

    zero = jnp.zeros(3)
    grad = np.asarray(jax.jit(jax.grad(f))(zero))
    h = 1e-5
    difference = np.array([float(f(zero.at[k].set(h)) - f(zero.at[k].set(-h))) for k in range(3)])
    difference = difference / (2 * h)
    print(f"{integrator}: gradient {grad}, central difference {difference}")
    assert np.abs(difference).min() > 1e-4
    np.testing.assert_allclose(grad, difference, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize("integrator", FAST)
def test_singular_strokes_have_finite_gradients(key, integrator, double):
    with jax.enable_x64(double):
        config, params = brush(key, integrator, irregularity=0.0, splay=0.0, iterations=1)
        # Straight, upright and symmetric: no direction is preferred, nothing bends at first.
        straight = jnp.zeros_like(params.rest).at[:, 2].set(-1.0)
        params = dataclasses.replace(
            params, rest=straight, length=jnp.full_like(params.length, 20.0)
        )
        upright = {"altitude": np.pi / 2, "azimuth": 0.0}
        dab = make_stroke(np.ones((1, 2)), np.zeros(1), 0.5, **upright)

        @jax.jit
        def slope(params, stroke):
            def f(params, position, pressure, altitude):
                moved = dataclasses.replace(
                    stroke, position=position, pressure=pressure, altitude=altitude
                )
                track = rollout(config, params, moved)
                return jnp.sum(track.position) + jnp.sum(track.force) + jnp.sum(track.velocity)

            return jax.grad(f, (0, 1, 2, 3))(
                params, stroke.position, stroke.pressure, stroke.altitude
            )

        for stroke in (
            drag(8, pressure=-0.5, **upright),
            drag(8, pressure=0.0, **upright),
            drag(8, pressure=0.5, speed=0.0, **upright),
            drag(8, altitude=0.0),
            pad(dab, 8),
            resample(dab, 8, 0.1, 0.01),
        ):
            assert_finite(slope(params, stroke))


@pytest.mark.parametrize("collapse", [0.0, 1e-12, 1.0])
def test_collapsed_chain_is_finite(key, collapse):
    # Failure 5: nodes on one point. The naive direction e / |e| is 0 / 0 from |e| = 0 on.
    config, params = brush(key, "implicit_euler", iterations=1)
    n = config.segments
    rest = params.rest * params.segment_length(n)[None, None]
    segment = rest * collapse if collapse < 1.0 else jnp.concatenate([rest[:2], 0.0 * rest[2:]])
    naive = jax.grad(lambda e: jnp.sum(e / jnp.linalg.norm(e, axis=1, keepdims=True)))(segment)
    print(f"collapse {collapse}: naive gradient finite: {bool(jnp.isfinite(naive).all())}")
    if collapse in (0.0, 1.0):
        assert not np.all(np.isfinite(np.asarray(naive)))
    stiffness, length = params.stretch_stiffness(n), params.segment_length(n)
    assert_finite(tension(stiffness, segment, length))
    assert_finite(jax.grad(lambda e: jnp.sum(tension(stiffness, e, length)))(segment))
    assert_finite(elastic_force(params, segment, rest))
    assert_finite(jax.grad(lambda e: jnp.sum(elastic_force(params, e, rest)))(segment))

    zero = jnp.zeros(3)
    pose = Pose(
        origin=zero.at[2].set(15.0),
        rotation=jnp.eye(3),
        dt=jnp.asarray(0.002),
        velocity=zero,
        jump=zero,
    )
    start = explicit.init(config, params, pose)

    @jax.jit
    def end(segment):
        start_node = params.root[None] + jnp.cumsum(segment, axis=0)
        state = dataclasses.replace(start, node=start_node)
        return jax.lax.scan(
            lambda s, _: implicit.step(config, params, s, pose), state, None, length=3
        )

    assert_finite(end(segment))
    assert_finite(jax.jit(jax.grad(lambda e: jnp.sum(end(e)[0].node)))(segment))


@pytest.mark.slow
@pytest.mark.parametrize("integrator", FAST)
def test_bristles_without_length_are_finite(key, integrator):
    config, params = brush(key, integrator, iterations=1)

    @jax.jit
    def slope(rest):
        values = dataclasses.replace(params, rest=rest)
        f = lambda rest: loss(rollout(config, dataclasses.replace(values, rest=rest), drag(8)))  # noqa: E731
        return jax.value_and_grad(f)(rest)

    # The chain starts at rest, so this rest shape gives it segments of no length.
    assert_finite(slope(jnp.zeros_like(params.rest)))


@pytest.mark.slow
@pytest.mark.parametrize("integrator", FAST)
def test_gradient_of_a_long_stroke(key, integrator):
    # Failure 7: growth of d(loss) / d(first stamps) with the number of stamps.
    config, params = brush(key, integrator, iterations=1)

    @jax.jit
    def slope(pressure, bending, stroke):
        moved = dataclasses.replace(stroke, pressure=pressure)
        values = dataclasses.replace(params, bending=bending)
        return loss(rollout(config, values, moved))

    size = {}
    for count in (20, 500):
        stroke = drag(count, dt=0.001)
        first, second = jax.grad(slope, (0, 1))(stroke.pressure, params.bending, stroke)
        assert_finite((first, second))
        ends = np.abs(np.asarray(first))
        size[count] = (float(ends[:5].max()), float(ends.max()), float(jnp.abs(second).max()))
    print(f"{integrator}: |gradient| in the first 5 pressures, all, bending by stamps: {size}")
    assert size[500][1] < 100.0 * size[20][1], "an exploding gradient"
    assert size[500][2] < 100.0 * size[20][2]
