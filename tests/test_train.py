import dataclasses
import functools
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.flatten_util import ravel_pytree

from jaxbrush import checkpoint, losses, train
from jaxbrush.models import Discriminator, DiscriminatorConfig, Generator, GeneratorConfig
from jaxbrush.train import Batch, TrainConfig, inference_variables, make_params, make_train

WIDTH = 0.0625
OPTIONS = TrainConfig(GeneratorConfig(width=WIDTH), DiscriminatorConfig(width=WIDTH), average=True)


def a_batch(seed=0, count=1, outputs=1, side=16):
    rng = np.random.default_rng(seed)
    inputs = rng.uniform(-1, 1, (count, side, side, 2)).astype(np.float32)
    target = np.tanh(inputs.sum(-1, keepdims=True)).repeat(outputs, -1)
    mask = np.ones((count, side, side, 1), np.float32)
    return jax.device_put(Batch(inputs, target, mask), jax.devices()[0])


@pytest.fixture(scope="module")
def training():
    """init, update, and what an initial state is made of, which updates consume."""
    init, update = make_train(OPTIONS)
    start = jax.device_get(init(jax.random.key(0), a_batch()))
    # On a named device, as restored arrays are: otherwise they would be compiled for anew.
    # Copied, since an update may reuse the memory of what it consumes.
    return update, lambda: jax.device_put(jax.tree.map(np.copy, start), jax.devices()[0])


def separately(state, batch, compiled: bool):
    """The two updates as two players, each with its own passes through both networks."""
    options = {"xla_backend_optimization_level": 0}
    prepare = functools.partial(jax.jit, compiler_options=options) if compiled else lambda f: f
    generator = Generator(OPTIONS.generator)
    discriminator = Discriminator(OPTIONS.discriminator)

    def paint(params):
        return generator.apply({"params": params}, batch.inputs)

    def judge(params, picture):
        return discriminator.apply({"params": params}, picture, batch.inputs)

    @prepare
    @jax.grad
    def for_generator(params):
        fake = paint(params)
        loss = losses.fool(judge(state.discriminator, fake)) + 10.0 * losses.l1(fake, batch.target)
        loss += 3.0 * losses.l2(fake, batch.target)
        return loss + 2.0 * losses.opacity(fake, batch.target) + losses.gradient(fake, batch.target)

    @prepare
    @functools.partial(jax.grad, has_aux=True)
    def for_discriminator(params):
        real = judge(params, batch.target)
        fake = judge(params, jax.lax.stop_gradient(paint(state.generator)))
        right = 0.5 * (jnp.mean(real > 0.0) + jnp.mean(fake < 0.0))
        return losses.tell_apart(real, fake), (right, jnp.std(fake))

    def moved(params, slopes):
        rule = optax.adam(2e-4, b1=0.5, b2=0.999)
        with jax.numpy_dtype_promotion("standard"):
            return optax.apply_updates(params, rule.update(slopes, rule.init(params))[0])

    slopes, judged = for_discriminator(state.discriminator)
    first = for_generator(state.generator)
    return moved(state.generator, first), moved(state.discriminator, slopes), first, judged


@pytest.mark.parametrize("compiled", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_update_is_the_two_updates_written_separately(training, compiled):
    update, start = training
    params = jax.device_put(make_params(l2=3.0, opacity=2.0, gradient=1.0), jax.devices()[0])
    begin = lambda: dataclasses.replace(start(), params=params)  # noqa: E731
    state, batch = begin(), a_batch()
    painter, judge, slopes, (right, spread) = separately(state, batch, compiled)
    found, metrics = update(begin(), batch)
    # Adam's first step is the sign of the slope times the rate, so slopes near 0 may differ.
    for ours, theirs, before in (
        (found.generator, painter, state.generator),
        (found.discriminator, judge, state.discriminator),
    ):
        step = lambda a, b: jnp.abs(a - b) > 1e-7  # noqa: E731
        off = jnp.concatenate(
            [x.ravel() for x in jax.tree.leaves(jax.tree.map(step, ours, theirs))]
        )
        assert float(jnp.mean(off)) < 2e-3
        assert max(
            float(jnp.abs(a - b).max())
            for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(before), strict=True)
        ) == pytest.approx(2e-4, rel=1e-2)
    norm = np.sqrt(sum(float(jnp.sum(x**2)) for x in jax.tree.leaves(slopes)))
    assert float(metrics["generator_slope"]) == pytest.approx(norm, rel=1e-4)
    assert float(metrics["accuracy"]) == pytest.approx(float(right), abs=1e-6)
    assert float(metrics["logit_spread"]) == pytest.approx(float(spread), rel=1e-4)
    assert bool(metrics["finite"]) and int(found.step) == 1


@pytest.mark.parametrize("outputs", [3, 4])
def test_light_is_that_through_and_from_heights_alone(outputs):
    """Of a network of colors there is none; one of both has its height last."""
    options = TrainConfig(GeneratorConfig(outputs, width=WIDTH, norm="none"), None)
    init, update = make_train(options)
    batch = a_batch(outputs=outputs)
    state = init(jax.random.key(0), batch, make_params(0.0, 0.0, 1e-3, opacity=1.0, gradient=1.0))
    variables, before = {"params": state.generator}, jax.tree.map(jnp.copy, state.generator)
    fake = Generator(options.generator).apply(variables, batch.inputs)
    state, metrics = update(state, batch)
    change = jax.tree.map(lambda a, b: jnp.abs(a - b), state.generator, before)
    last = change["decode4"]["bias"]
    if outputs == 3:
        assert not {"opacity", "gradient"} & metrics.keys()
        assert max(float(x.max()) for x in jax.tree.leaves(change)) == 0.0
    else:
        for name in ("opacity", "gradient"):
            expected = getattr(losses, name)(fake[..., 3:], batch.target[..., 3:])
            assert float(metrics[name]) == pytest.approx(float(expected), rel=1e-4)
        assert float(last[:3].max()) == 0.0 and float(last[3]) > 0.0


def test_average_follows_the_parameters(training):
    update, start = training
    state = start()
    found, _ = update(start(), a_batch())
    jax.tree.map(
        lambda a, b, c: np.testing.assert_allclose(a, 0.1 * b + 0.9 * c, atol=1e-7),
        found.average,
        state.average,
        found.generator,
    )
    assert inference_variables(found)["params"] is found.average


def test_one_compilation_serves_a_sweep_and_nothing_leaves_the_device(training):
    update, start = training
    state, batches = start(), [a_batch(seed) for seed in range(2)]
    state, _ = update(state, batches[0])
    sweep = [
        jax.device_put(
            make_params(l1, gan, rate, 3 * rate, l2=l2, opacity=l2, gradient=l2),
            jax.devices()[0],
        )
        for l1, gan, rate, l2 in (
            (10.0, 0.0, 1e-3, 0.0),
            (0.0, 1.0, 1e-4, 3.0),
            (9.0, 1.0, 0.0, 1.0),
        )
    ]
    count = update._cache_size()
    with jax.transfer_guard("disallow"):
        for params in sweep:
            state = dataclasses.replace(state, params=params)
            before = jax.tree.map(jnp.copy, state.generator)
            for batch in batches:
                state, metrics = update(state, batch)
    assert update._cache_size() == count
    assert float(metrics["finite"]) == 1.0
    # The last of the sweep has no learning rate.
    jax.tree.map(np.testing.assert_array_equal, state.generator, before)


def test_state_is_consumed(training):
    update, start = training
    state = start()
    update(state, a_batch())
    assert all(leaf.is_deleted() for leaf in jax.tree.leaves(state.generator))


def test_loss_falls_and_is_reported_finite(training):
    update, start = training
    state, batch = start(), a_batch()
    state = dataclasses.replace(
        state,
        params=jax.device_put(
            make_params(generator_rate=2e-3, discriminator_rate=2e-3), jax.devices()[0]
        ),
    )
    found = []
    for _ in range(60):
        state, metrics = update(state, batch)
        found.append(jax.device_get(metrics))
    assert found[-1]["l1"] < 0.3 * found[0]["l1"]
    assert all(m["finite"] for m in found)
    assert 0.0 <= found[-1]["accuracy"] <= 1.0 and found[-1]["gradient_ratio"] > 0.0


@pytest.mark.slow
def test_one_odd_picture_does_not_undo_the_training(monkeypatch):
    """After 400 usual updates: uncut, Adam's step is 8 times as long as usual."""
    usual = [a_batch(k) for k in range(8)]
    usual = [dataclasses.replace(x, inputs=0.1 * x.inputs, target=0.1 * x.target) for x in usual]
    odd = dataclasses.replace(usual[0], inputs=200.0 * usual[0].inputs, target=a_batch(0).target)

    def run(clip):
        """Of three starts: length of the odd step [rates], error after it over that before."""
        monkeypatch.setattr(train, "CLIP", clip)
        init, update = make_train(TrainConfig(GeneratorConfig(width=WIDTH, norm="none"), None))
        steps, worse = [], []
        for seed in (0, 2, 3):
            state, found = init(jax.random.key(seed), odd, make_params(10.0, 0.0, 1e-3)), []
            for k in range(409):
                before = ravel_pytree(state.generator)[0]
                state, metrics = update(state, odd if k == 400 else usual[k % 8])
                found.append(float(metrics["l1"]))
                if k == 400:
                    moved = ravel_pytree(state.generator)[0] - before
                    steps.append(float(jnp.sqrt(jnp.mean(moved**2))) / 1e-3)
            worse.append(np.mean(found[401:]) / np.mean(found[392:400]))
        return np.array(steps), np.mean(worse)

    steps, worse = run(train.CLIP)
    np.testing.assert_allclose(steps, 1.0, rtol=1e-3)
    assert worse < 1.4
    steps, worse = run(np.inf)
    assert steps.min() > 4.0 and worse > 1.6


def test_what_is_not_finite_is_reported_by_the_same_step(training):
    update, start = training
    batch = a_batch()
    broken = dataclasses.replace(batch, target=batch.target.at[0, 3, 3, 0].set(jnp.nan))
    state, metrics = update(start(), broken)
    assert not metrics["finite"]
    _, metrics = update(state, batch)
    assert not metrics["finite"]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_resumed_run_is_bit_equal(training, tmp_path):
    update, start = training
    batches = [a_batch(seed) for seed in range(4)]
    straight = start()
    for batch in batches:
        straight, _ = update(straight, batch)
    state = start()
    for batch in batches[:2]:
        state, _ = update(state, batch)
    with checkpoint.opened(tmp_path, OPTIONS) as checkpoints:
        checkpoint.save(checkpoints, state, {"next": 2})
    abstract = jax.eval_shape(make_train(OPTIONS)[0], jax.random.key(0), batches[0])
    with checkpoint.opened(tmp_path, OPTIONS) as checkpoints:
        found = checkpoint.restore(checkpoints, abstract)
    state = found.state
    for batch in batches[found.notes["next"] :]:
        state, _ = update(state, batch)
    jax.tree.map(np.testing.assert_array_equal, state, straight)


def test_batches_that_do_not_fit_are_named(training):
    update, start = training
    batch = a_batch()
    wrong = {
        "target": (a_batch(outputs=3).target, r"batch.target is .*3\): expected .*1\)"),
        "mask": (batch.mask[:, :8], "batch.mask is"),
        "inputs": (batch.inputs.astype(jnp.bfloat16), "batch.inputs is bfloat16"),
    }
    for name, (value, message) in wrong.items():
        with pytest.raises(ValueError, match=message):
            update.lower(start(), dataclasses.replace(batch, **{name: value}))


@pytest.mark.slow
def test_l1_alone_is_a_cgan_weight_of_zero(training):
    update, start = training
    init, alone = make_train(dataclasses.replace(OPTIONS, discriminator=None))
    state = start()
    other = dataclasses.replace(
        start(), discriminator=None, discriminator_adam=None, params=make_params(gan=0.0)
    )
    shapes = jax.eval_shape(init, jax.random.key(0), a_batch())
    assert jax.tree.structure(shapes) == jax.tree.structure(other)
    state = dataclasses.replace(state, params=make_params(gan=0.0))
    for seed in range(3):
        state, _ = update(state, a_batch(seed))
        other, metrics = alone(other, a_batch(seed))
    assert set(metrics) == {"l1", "l2", "opacity", "gradient", "generator_slope", "finite"}
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=2e-5), state.generator, other.generator
    )


@pytest.mark.slow
@pytest.mark.parametrize("norm", ["batch", "masked", "none"])
@pytest.mark.parametrize("upsampling", ["resize", "transposed"])
def test_every_option_learns(norm, upsampling):
    options = TrainConfig(
        GeneratorConfig(width=0.125, norm=norm, upsampling=upsampling, dtype="bfloat16"),
        DiscriminatorConfig(width=0.125, norm=norm, dtype="bfloat16"),
    )
    init, update = make_train(options)
    state = init(jax.random.key(0), a_batch(), make_params(generator_rate=2e-3))
    first = None
    for _ in range(150):
        state, metrics = update(state, a_batch())
        first = first or float(metrics["l1"])
    assert bool(metrics["finite"]) and float(metrics["l1"]) < 0.6 * first
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(state.generator))


MESH = """
import jax, numpy as np
from jax.sharding import Mesh
from test_train import OPTIONS, a_batch
from jaxbrush.train import data_sharding, make_train

assert jax.device_count() == 8
mesh = Mesh(np.array(jax.devices()), ("data",))
copied, split = data_sharding(mesh)
batch = a_batch(count=8)
init, one = make_train(OPTIONS)
start = jax.device_get(init(jax.random.key(0), batch))
_, many = make_train(OPTIONS, mesh)
a, b = jax.device_put(start), jax.device_put(start, copied)
with jax.transfer_guard("disallow"):
    shared = jax.device_put(batch, split)
    for _ in range(3):
        a, first = one(a, batch)
        b, second = many(b, shared)
assert len(b.step.sharding.device_set) == 8 and b.step.sharding.is_fully_replicated
assert many._cache_size() == 1
for x, y in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
    np.testing.assert_allclose(x, y, rtol=1e-3)
off = [np.abs(np.asarray(x) - np.asarray(y)).ravel() for x, y in
       zip(jax.tree.leaves(a.generator), jax.tree.leaves(b.generator), strict=True)]
# A slope near 0 may change sign with the order of a sum, and Adam steps by its sign.
assert np.mean(np.concatenate(off) > 1e-6) < 0.02, np.mean(np.concatenate(off) > 1e-6)
print("equal")
"""


@pytest.mark.slow
def test_eight_devices_are_one():
    here = os.path.dirname(__file__)
    env = os.environ | {
        "XLA_FLAGS": "--xla_force_host_platform_device_count=8",
        "PYTHONPATH": os.pathsep.join([here, os.path.dirname(here)]),
    }
    run = subprocess.run([sys.executable, "-c", MESH], env=env, capture_output=True, text=True)
    assert "equal" in run.stdout, run.stderr[-3000:]
