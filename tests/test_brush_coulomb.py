"""The single contact with friction, against its own conditions; and a sliding point mass."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbrush.brush import BrushConfig, explicit
from jaxbrush.brush.contact import coulomb

GRAVITY = 9807.0
solve = jax.jit(coulomb)


def scalar(x):
    return jnp.full(1, x, float)


def on_incline(tangent, friction):
    """Weight 1 on an incline, force of the surface in its own axes (x downhill), (3,)."""
    angle = np.arctan(tangent)
    one, none = scalar(1.0), scalar(0.0)
    free = (scalar(np.sin(angle)), none, scalar(-np.cos(angle)))
    force = solve((one, none, none, one, none, one), free, jnp.asarray(friction), (none, none))
    return np.array([float(x[0]) for x in force]), angle


@pytest.mark.parametrize("friction", [0.1, 0.25, 0.8])
def test_slides_only_on_a_steep_incline(x64, friction):
    force, angle = on_incline(0.99 * friction, friction)
    np.testing.assert_allclose(force, [-np.sin(angle), 0.0, np.cos(angle)], atol=1e-6)
    for steeper in (1.01, 2.0):
        force, angle = on_incline(steeper * friction, friction)
        normal = np.cos(angle)
        np.testing.assert_allclose(force, [-friction * normal, 0.0, normal], atol=1e-6)


def test_random_contacts_obey_coulomb(x64):
    rng = np.random.default_rng(0)
    b, mu = 2000, 0.3
    root = rng.normal(size=(b, 3, 3)) * [1.0, 1.0, 0.5]
    g = root @ root.transpose(0, 2, 1) + 0.3 * np.eye(3)
    free = rng.normal(size=(b, 3)) * [1.0, 1.0, 1.0]
    pick = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    compliance = tuple(jnp.asarray(g[:, i, j]) for i, j in pick)
    start = tuple(jnp.asarray(free[:, k]) for k in range(3))
    last = (jnp.zeros(b), jnp.zeros(b))
    wrong = {}
    for stamp in range(30):
        # A stamp gives the next one its force as a first guess of the direction of slip.
        force = solve(compliance, start, jnp.asarray(mu), last)
        last = force[:2]
        f = np.stack([np.asarray(x) for x in force], 1)
        u = free + np.einsum("bij,bj->bi", g, f)
        ft, ut = np.linalg.norm(f[:, :2], axis=1), np.linalg.norm(u[:, :2], axis=1)
        slips = ut > 1e-7
        errors = [
            np.maximum(-u[:, 2], 0.0),
            np.maximum(-f[:, 2], 0.0),
            np.abs(u[:, 2] * f[:, 2]),
            np.maximum(ft - mu * f[:, 2] - 1e-9, 0.0),
            # Slip: the force is on the cone and against the displacement.
            np.where(slips, np.abs(ft - mu * f[:, 2]), 0.0),
            np.where(slips, np.abs((f[:, :2] * u[:, :2]).sum(1) + ft * ut), 0.0),
        ]
        wrong[stamp] = np.mean(np.max(errors, axis=0) > 1e-3)
    touching = free[:, 2] < 0.0
    print(f"share of contacts off Coulomb's law by 1e-3 after stamps: {wrong}")
    assert np.all(f[free[:, 2] > 0.5][:, 2] >= 0.0) and touching.any()
    assert (slips & touching).mean() > 0.2 and (~slips).mean() > 0.02
    assert wrong[0] < 0.25
    # What is left jams: steep compliances for which no or several solutions exist.
    assert wrong[29] < 0.02


@pytest.mark.parametrize("friction", [0.2, 0.6])
def test_stopping_distance(x64, friction):
    dt, speed = 1e-4, 200.0
    config = BrushConfig(nodes=4, contact_nodes=1)
    params = types.SimpleNamespace(friction=jnp.asarray(friction))
    zero, mass = jnp.zeros(3), jnp.ones((2, 1, 1))

    def body(carry, _):
        node, velocity = carry
        free = node + dt * (velocity - dt * GRAVITY * jnp.eye(3)[2][None, :, None])
        moved, _ = explicit._touch(config, params, None, mass, node, free, zero, zero, dt, 0.0)
        return (moved, (moved - node) / dt), None

    node = jnp.zeros((2, 3, 1))
    velocity = node.at[:, 0].set(speed)
    (node, velocity), _ = jax.lax.scan(body, (node, velocity), None, length=3000)
    exact = speed**2 / (2 * friction * GRAVITY)
    print(
        f"mu = {friction}: stops after {float(node[-1, 0, 0]):.4f} mm, v^2 / (2 mu g) {exact:.4f}"
    )
    assert float(jnp.abs(velocity[-1]).max()) < 1e-9
    assert float(node[-1, 0, 0]) == pytest.approx(exact, rel=0.02)
