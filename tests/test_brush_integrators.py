"""Order, energy and stability of the time integrators, in free motion."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbrush.brush import (
    BrushConfig,
    BrushParams,
    Surface,
    explicit,
    implicit,
    make_brush,
    rollout,
    stable_dt,
)
from jaxbrush.brush.forces import elastic_energy, node_mass
from jaxbrush.brush.handle import Pose
from jaxbrush.stylus import make_stroke

LENGTH, BENDING, MASS = 20.0, 9.94e4, 2.3e-5
jit_rollout = jax.jit(rollout)


def straight(segments, ratio=4.0, damping=0.0):
    """One straight bristle, `ratio` times stiffer along a segment than across it."""
    l0 = LENGTH / segments
    scalar = functools.partial(jnp.asarray, dtype=float)
    return BrushParams(
        root=jnp.zeros((3, 1)),
        rest=jnp.concatenate([jnp.zeros((segments, 2, 1)), -jnp.ones((segments, 1, 1))], axis=1),
        length=jnp.full(1, LENGTH),
        bending=jnp.full(1, BENDING),
        stretch=jnp.full(1, ratio * BENDING / l0**2),
        mass=jnp.full(1, MASS),
        damping=scalar(damping),
        friction=scalar(0.0),
        press_depth=scalar(1.0),
        press_force=scalar(100.0),
        area=scalar(0.02),
    )


def air():
    return Surface(height=jnp.full((1, 1), -1e3), pixel=jnp.asarray(1.0))


def still(dt):
    """A handle that stays where it is."""
    zero = jnp.zeros(3)
    return Pose(
        origin=jnp.asarray([0.0, 0.0, 1e3]),
        rotation=jnp.eye(3),
        dt=jnp.asarray(dt, float),
        velocity=zero,
        jump=zero,
    )


def rest_node(params, n):
    return jnp.cumsum(params.rest * params.segment_length(n)[None, None], axis=0)


@functools.partial(jax.jit, static_argnums=0)
def _stiffness(n, params):
    rest = params.rest * params.segment_length(n)[None, None]

    def energy(x):
        node = x.reshape(n, 3, 1)
        return elastic_energy(params, jnp.concatenate([node[:1], node[1:] - node[:-1]]), rest)[0]

    return jax.hessian(energy)(rest_node(params, n).reshape(3 * n))


def modes(params, n):
    """Angular frequencies, ascending, and mode shapes (3 n, modes) with unit modal mass."""
    mass = np.repeat(np.asarray(node_mass(params, n))[:, 0, 0], 3)
    root = 1.0 / np.sqrt(mass)
    square, shape = np.linalg.eigh(root[:, None] * np.asarray(_stiffness(n, params)) * root[None])
    return np.sqrt(square), root[:, None] * shape


@functools.partial(jax.jit, static_argnums=(0, 3))
def run(config, params, start, steps, dt):
    """States (steps, n, 3, 1) of node and velocity under a handle that rests."""
    module = implicit if config.integrator == "implicit_euler" else explicit

    def body(state, _):
        state, _ = module.step(config, params, state, still(dt))
        return state, (state.node, state.velocity)

    return jax.lax.scan(body, start, None, length=steps)[1]


def started(config, params, offset):
    start = explicit.init(config, params, still(1e-3))
    offset = jnp.asarray(offset).reshape(start.node.shape)
    return dataclasses.replace(start, node=start.node + offset)


def linear_energy(params, n, node, velocity):
    """Energy (t,) to second order about rest, of (t, n, 3, 1)."""
    x = np.asarray(node - rest_node(params, n)[None]).reshape(len(node), -1)
    v = np.asarray(velocity).reshape(len(node), -1)
    mass = np.repeat(np.asarray(node_mass(params, n))[:, 0, 0], 3)
    stiff = np.asarray(_stiffness(n, params))
    return 0.5 * (np.einsum("ti,ij,tj->t", x, stiff, x) + (v * v) @ mass)


def kicked(integrator, steps, time=0.006, speed=300.0):
    """Tip at `time` after the handle jumps to a constant speed, relative to the handle."""
    n = 3
    config = BrushConfig(
        nodes=n + 1, contact_nodes=1, integrator=integrator, approach=0, iterations=2
    )
    dt = time / steps
    # Two stamps at rest, so that the jump of velocity falls on a stamp of length dt.
    at = np.maximum(np.arange(steps + 2) - 1, 0) * dt * speed
    stroke = make_stroke(np.stack([at, 0 * at], 1), dt * np.arange(steps + 2), 0.0)
    track = jit_rollout(config, straight(n, damping=100.0), stroke, air())
    return np.asarray(track.position[-1, -1, :, 0]) - [at[-1], 0.0, 0.0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "integrator, order, coarse",
    [("symplectic_euler", 1, 200), ("verlet", 2, 200), ("implicit_euler", 1, 800),
     ("projective", 1, 800)],
)  # fmt: skip
def test_order_of_free_vibration(x64, integrator, order, coarse):
    tips = [kicked(integrator, coarse * 2**k) for k in range(4)]
    change = [float(np.linalg.norm(b - a)) for a, b in zip(tips, tips[1:], strict=False)]
    observed = np.log2(np.array(change[:-1]) / change[1:])
    print(f"{integrator}: changes {change} mm, observed order {observed}")
    assert np.linalg.norm(tips[-1][:2]) > 0.05, "no vibration to measure"
    assert observed[-1] == pytest.approx(order, abs=0.15)


def test_verlet_keeps_energy_without_damping(x64):
    n = 3
    params = straight(n)
    w, shape = modes(params, n)
    dt = 0.1 / w[-1]
    config = BrushConfig(nodes=n + 1, contact_nodes=1, integrator="verlet")
    mixed = shape @ (np.ones(3 * n) / w)
    start = started(config, params, 1e-4 * mixed / np.abs(mixed).max())
    periods = 200
    steps = int(periods * 2 * np.pi / w[0] / dt)
    energy = linear_energy(params, n, *run(config, params, start, steps, dt))
    quarter = steps // 4
    first, last = energy[:quarter].mean(), energy[-quarter:].mean()
    swing = np.ptp(energy) / first
    print(
        f"Verlet, {periods} periods, w_max dt = 0.1: swing {swing:.1e}, "
        f"drift {last / first - 1:.1e}"
    )
    assert swing < 0.01
    assert last == pytest.approx(first, rel=1e-4)


@pytest.mark.parametrize("product", [0.1, 0.58, 3.0])
def test_implicit_euler_decay_of_a_mode(x64, product):
    n = 5
    params = straight(n)
    w, shape = modes(params, n)
    for mode in (0, 2, 3 * n - 1):
        dt = product / w[mode]
        config = BrushConfig(
            nodes=n + 1, contact_nodes=1, integrator="implicit_euler", iterations=2
        )
        start = started(config, params, 1e-6 * shape[:, mode] / np.abs(shape[:, mode]).max())
        energy = linear_energy(params, n, *run(config, params, start, 8, dt))
        factor = energy[1:] / energy[:-1]
        np.testing.assert_allclose(factor, 1.0 / (1.0 + product**2), rtol=1e-4)


@pytest.mark.parametrize("integrator", ["symplectic_euler", "verlet"])
def test_explicit_breaks_at_the_limit(x64, key, integrator):
    n = 4
    params = straight(n)
    limit = 2.0 / modes(params, n)[0][-1]
    config = BrushConfig(nodes=n + 1, contact_nodes=1, integrator=integrator)
    start = started(config, params, 1e-6 * jax.random.normal(key, (n, 3, 1)))
    size = {}
    for share in (0.5, 0.9, 0.99, 1.01, 1.1, 2.0):
        node, _ = run(config, params, start, 300, share * limit)
        size[share] = float(np.abs(np.asarray(node) - np.asarray(rest_node(params, n))[None]).max())
    print(f"{integrator}: largest offset [mm] by dt / (2 / w_max), from 1e-6: {size}")
    assert all(size[s] < 1e-4 for s in (0.5, 0.9, 0.99))
    assert all(not size[s] < 1.0 for s in (1.01, 1.1, 2.0))


@pytest.mark.parametrize("ratio", [0.01, 1.0, 4.0, 40.0, 1000.0])
def test_stable_dt_is_a_close_lower_bound(x64, ratio):
    for n in (2, 3, 5, 11):
        params = straight(n, ratio)
        exact = 2.0 / modes(params, n)[0][-1]
        share = float(stable_dt(params, n)) / exact
        print(f"n = {n}, stretch/bending {ratio}: stable_dt / exact limit = {share:.4f}")
        assert share <= 1.0
        if ratio >= 40.0 and n >= 5:
            assert share > 0.9


@pytest.mark.parametrize("damping", [0.0, 600.0, 1e5])
@pytest.mark.parametrize("integrator", ["symplectic_euler", "verlet"])
def test_stable_dt_holds_with_damping(x64, key, integrator, damping):
    n = 5
    params = straight(n, 40.0, damping)
    config = BrushConfig(nodes=n + 1, contact_nodes=1, integrator=integrator)
    start = started(config, params, 1e-6 * jax.random.normal(key, (n, 3, 1)))
    node, _ = run(config, params, start, 300, 0.99 * float(stable_dt(params, n)))
    assert float(np.abs(np.asarray(node) - np.asarray(rest_node(params, n))[None]).max()) < 1e-4


@pytest.mark.parametrize(
    "integrator", ["symplectic_euler", "quasi_static", "projective", "implicit_euler"]
)
def test_a_thousand_times_the_explicit_step(key, integrator):
    config = BrushConfig(integrator=integrator, iterations=1)
    params = make_brush(key, config, "flat", 8)
    dt = 1000.0 * float(stable_dt(params, config.segments))
    t = np.arange(40)
    path = np.stack([80.0 * dt * t, 20.0 * np.sin(0.3 * t)], 1)
    stroke = make_stroke(path, dt * t, 0.6, altitude=1.1, azimuth=0.7)
    track = jit_rollout(config, params, stroke)
    position = np.asarray(track.position)
    reach = np.abs(position[:, :, :2] - path[:, None, :, None]).max()
    print(f"{integrator}: stamps of {dt * 1e3:.1f} ms, tips up to {reach:.3g} mm from the stylus")
    if integrator == "symplectic_euler":
        assert not reach < 1e3, "the naive method should break here"
        return
    for leaf in jax.tree.leaves(track):
        assert np.all(np.isfinite(np.asarray(leaf)))
    assert reach < 30.0
    assert position[:, :, 2].min() > -0.5


@pytest.mark.parametrize("integrator", ["quasi_static", "projective", "implicit_euler"])
def test_half_press_in_one_step(key, integrator):
    # Failure 2: a straight upright brush pressed by half its length at once, without approach.
    config = BrushConfig(integrator=integrator, approach=1, iterations=2)
    params = make_brush(key, config, "flat", 8, irregularity=0.2, press_depth=10.0)
    stroke = make_stroke(np.zeros((80, 2)), 0.002 * np.arange(80), 1.0)
    stroke = dataclasses.replace(stroke, pressure=stroke.pressure.at[0].set(0.0))
    track = jit_rollout(config, params, stroke)
    for leaf in jax.tree.leaves(track):
        assert np.all(np.isfinite(np.asarray(leaf)))
    force = np.asarray(track.force).sum((1, 2))
    print(f"{integrator}: force after 1, 2, 5, 80 stamps {force[[1, 2, 5, 79]]} µN")
    assert np.asarray(track.position)[-1, :, 2].min() > -0.1
    assert force[-1] == pytest.approx(force[-2], rel=0.01)
