"""What must not change the motion: place, direction, order, speed, batching, compilation."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbrush.brush import BrushConfig, Surface, make_brush, rollout, stable_dt
from jaxbrush.brush.shapes import INTEGRATORS
from jaxbrush.stylus import make_stroke, transform

FAST = ("quasi_static", "projective", "implicit_euler")
BRISTLE_LAST = ("root", "rest", "length", "bending", "stretch", "mass")
jit_rollout = jax.jit(rollout)


def curve(count=40, dt=0.003, **values):
    s = np.linspace(0.0, 1.0, count)
    path = np.stack([12.0 * s, 4.0 * np.sin(3.0 * s)], 1)
    default = {
        "pressure": 0.2 + 0.3 * s,
        "altitude": 1.3 - 0.3 * s,
        "azimuth": 0.4 + s,
        "twist": 0.5 * s,
    }
    return make_stroke(path, dt * np.arange(count), **(default | values))


def brush(key, integrator, bristles=3, stretch=0.01, dt=0.003, **values):
    """A small brush, and substeps that keep the explicit integrators stable."""
    config = BrushConfig(nodes=5, integrator=integrator, contact_nodes=2, approach=4)
    params = make_brush(key, config, "flat", bristles, **values)
    params = dataclasses.replace(params, stretch=params.stretch * stretch)
    if integrator not in FAST:
        steps = int(np.ceil(dt / (0.9 * float(stable_dt(params, config.segments)))))
        config = dataclasses.replace(config, substeps=steps)
    return config, params


def assert_close(got, want, scale):
    np.testing.assert_allclose(got.position, want.position, atol=1e-7 * scale)
    np.testing.assert_allclose(got.force, want.force, rtol=1e-6 * scale, atol=1e-4 * scale)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_place_direction_and_order(x64, key, integrator):
    config, params = brush(key, integrator)
    stroke = curve()
    track = jit_rollout(config, params, stroke)
    assert float(track.force[-1].sum()) > 10.0

    moved = jit_rollout(config, params, transform(stroke, translate=(7.0, -3.0)))
    position = moved.position - jnp.asarray([7.0, -3.0, 0.0])[None, None, :, None]
    assert_close(dataclasses.replace(moved, position=position), track, 1.0)

    angle = 2.1
    turned = jit_rollout(config, params, transform(stroke, rotate=angle))
    c, s = np.cos(angle), np.sin(angle)
    back = jnp.asarray([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    position = jnp.einsum("ij,tmjb->tmib", back, turned.position)
    assert_close(dataclasses.replace(turned, position=position), track, 10.0)
    np.testing.assert_allclose(turned.reaction @ back.T, track.reaction, rtol=1e-4, atol=1e-2)

    order = np.array([2, 0, 1])
    values = {name: getattr(params, name)[..., order] for name in BRISTLE_LAST}
    mixed = jit_rollout(config, dataclasses.replace(params, **values), stroke)
    np.testing.assert_allclose(mixed.position, track.position[..., order], atol=1e-7)
    np.testing.assert_allclose(mixed.force, track.force[..., order], rtol=1e-6, atol=1e-4)
    np.testing.assert_allclose(mixed.reaction, track.reaction, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_galilean(x64, key, integrator):
    config, params = brush(key, integrator, dt=0.001)
    air = Surface(height=jnp.full((1, 1), -100.0), pixel=jnp.asarray(1.0))
    path = np.stack([0.4 * np.arange(50), -0.2 * np.arange(50)], 1)
    stroke = make_stroke(path, 0.001 * np.arange(50), 0.3)
    # Without approach the brush is born in motion, so nothing may move in its frame.
    config = dataclasses.replace(config, approach=0)
    track = jit_rollout(config, params, stroke, air)
    own = np.asarray(track.position[:, :, :2]) - path[:, None, :, None]
    print(f"{integrator}: moved in its own frame by {np.abs(own - own[:1]).max():.1e} mm")
    np.testing.assert_allclose(own, np.broadcast_to(own[:1], own.shape), atol=1e-6)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_length_at_full_speed(key, integrator):
    config = BrushConfig(nodes=5, integrator=integrator, track_nodes=4, iterations=2)
    params = make_brush(key, config, "flat", 3, irregularity=0.5)
    dt = 0.0005
    if integrator not in FAST:
        # The brush comes down in steps of 1 ms, longer than the stamps here.
        steps = int(np.ceil(0.001 / (0.9 * float(stable_dt(params, config.segments)))))
        config = dataclasses.replace(config, substeps=steps)
    t = dt * np.arange(120)
    path = np.stack([480.0 * t, np.zeros_like(t)], 1)
    stroke = make_stroke(path, t, 0.4, altitude=1.1, azimuth=np.pi)
    track = jit_rollout(config, params, stroke)
    node = np.asarray(track.position)
    segment = np.linalg.norm(node[:, 1:] - node[:, :-1], axis=2)
    length = np.asarray(params.segment_length(config.segments))
    error = np.abs(segment / length - 1.0).max()
    print(f"{integrator} at 480 mm/s: length error {error:.1e}")
    assert error < 0.01


@pytest.mark.parametrize("integrator", FAST)
def test_vmap_is_a_loop(x64, key, integrator):
    config, params = brush(key, integrator)
    strokes = [curve(pressure=p) for p in (0.2, 0.5)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *strokes)
    batch = jax.jit(jax.vmap(lambda s: rollout(config, params, s)))(stacked)
    for k, stroke in enumerate(strokes):
        one = jit_rollout(config, params, stroke)
        assert_close(jax.tree.map(lambda x, k=k: x[k], batch), one, 1.0)

    def stiffer(factor):
        values = dataclasses.replace(params, bending=params.bending * factor)
        return rollout(config, values, strokes[0])

    factors = jnp.asarray([0.5, 2.0])
    batch = jax.jit(jax.vmap(stiffer))(factors)
    for k in range(2):
        values = dataclasses.replace(params, bending=params.bending * factors[k])
        one = jit_rollout(config, values, strokes[0])
        assert_close(jax.tree.map(lambda x, k=k: x[k], batch), one, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", FAST)
def test_jit_is_op_by_op(x64, key, integrator):
    config, params = brush(key, integrator)
    config = dataclasses.replace(config, approach=1)
    stroke = jax.tree.map(lambda x: x[:3], curve())
    with jax.disable_jit():
        plain = rollout(config, params, stroke)
    assert_close(jit_rollout(config, params, stroke), plain, 1.0)


def test_second_call_does_not_compile(key):
    traces = []

    @jax.jit
    def run(config, params, stroke):
        traces.append(1)
        return rollout(config, params, stroke)

    config, params = brush(key, "quasi_static")
    run(config, params, curve())
    other = jax.tree.map(lambda x: x * 1.01, params)
    run(BrushConfig(nodes=5, contact_nodes=2, approach=4), other, curve(pressure=0.1, twist=0.2))
    assert len(traces) == 1 and run._cache_size() == 1


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_dtype_is_kept(key, integrator):
    config = BrushConfig(nodes=4, integrator=integrator, approach=1)
    single = make_brush(key, config, bristles=2)
    stroke = curve(3)

    def dtypes(params, stroke):
        track = jax.eval_shape(lambda p, s: rollout(config, p, s), params, stroke)
        return {x.dtype for x in (track.position, track.force, track.reaction)}

    assert dtypes(single, stroke) == {np.dtype("float32")}
    with jax.enable_x64(True):
        double = make_brush(key, config, bristles=2)
        assert dtypes(double, curve(3)) == {np.dtype("float64")}


def test_all_bristles_as_guides_changes_nothing(key):
    config, params = brush(key, "quasi_static")
    stroke = curve()
    want = jit_rollout(config, params, stroke)
    got = jit_rollout(dataclasses.replace(config, guides=3), params, stroke)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        np.testing.assert_array_equal(a, b)


def test_guides_carry_the_force_of_all(key):
    config, params = brush(key, "quasi_static", bristles=32)
    stroke = curve()
    want = jit_rollout(config, params, stroke)
    got = jit_rollout(dataclasses.replace(config, guides=16), params, stroke)
    ratio = float(got.force[20:].sum() / want.force[20:].sum())
    print(f"16 guides of 32: force {ratio:.3f} of all bristles'")
    assert got.position.shape == want.position.shape
    assert ratio == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize(
    "values, words",
    [
        ({"nodes": 2}, ("nodes", "2")),
        ({"contact_nodes": 0}, ("contact_nodes", "0")),
        ({"nodes": 5, "contact_nodes": 5}, ("contact_nodes", "5")),
        ({"iterations": 0}, ("iterations", "0")),
        ({"substeps": 1.5}, ("substeps", "1.5")),
        ({"approach": -1}, ("approach", "-1")),
        ({"guides": -2}, ("guides", "-2")),
        ({"integrator": "euler"}, ("integrator", "euler")),
        ({"press": "weight"}, ("press", "weight")),
        ({"press": "force", "integrator": "verlet"}, ("press", "verlet")),
    ],
)
def test_config_errors_name_argument_and_value(values, words):
    with pytest.raises(ValueError) as error:
        BrushConfig(**values)
    assert all(word in str(error.value) for word in words)


def test_brush_and_rollout_errors(key):
    config = BrushConfig(nodes=5)
    with pytest.raises(ValueError, match="shape = 'mop'"):
        make_brush(key, config, "mop", 3)
    with pytest.raises(ValueError, match="bristles = 0"):
        make_brush(key, config, "flat", 0)
    params, stroke = make_brush(key, config, "flat", 3), curve(3)
    with pytest.raises(ValueError, match=r"params.rest has shape \(4, 3, 3\)"):
        rollout(BrushConfig(nodes=6), params, stroke)
    with pytest.raises(ValueError, match=r"params.root has shape \(2, 3\)"):
        rollout(config, dataclasses.replace(params, root=params.root[:2]), stroke)
    with pytest.raises(ValueError, match="stroke.position has shape"):
        rollout(config, params, jax.tree.map(lambda x: x[None], stroke))
    with pytest.raises(ValueError, match="guides = 4"):
        rollout(dataclasses.replace(config, guides=4), params, stroke)
