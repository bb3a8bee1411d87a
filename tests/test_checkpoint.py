import dataclasses
import json
import multiprocessing
import resource
import shutil
import signal
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbrush import checkpoint
from jaxbrush.models import DiscriminatorConfig, Generator, GeneratorConfig
from jaxbrush.train import Batch, TrainConfig, inference_variables, make_train

OPTIONS = TrainConfig(GeneratorConfig(width=0.0625), DiscriminatorConfig(width=0.03))
SHAPE = (1, 8, 8)
# Orbax's threads and event loops are closed late.
pytestmark = [
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]


def _batch():
    picture = jnp.zeros((*SHAPE, 1))
    return Batch(jnp.zeros((*SHAPE, 2)), picture, picture)


def _filled(abstract, seed):
    """Numbers in place of a compiled initialisation."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), x.dtype), abstract)


@pytest.fixture(scope="module")
def abstract():
    return jax.eval_shape(make_train(OPTIONS)[0], jax.random.key(0), _batch())


@pytest.fixture(scope="module")
def initial(abstract):
    return _filled(abstract, 0)


def at(state, step):
    return dataclasses.replace(
        state,
        step=jnp.asarray(step, jnp.int32),
        generator=jax.tree.map(lambda p: p + jnp.float32(step), state.generator),
    )


def same(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_last_two_and_best_are_kept_and_come_back_bit_for_bit(tmp_path, initial, abstract):
    with checkpoint.opened(tmp_path, OPTIONS) as checkpoints:
        assert checkpoint.restore(checkpoints, abstract) is None
        for step, score in enumerate((3.0, 1.0, 4.0, 2.0, 5.0)):
            checkpoint.save(checkpoints, at(initial, step), {"pairs": 10 * step}, score)
    with checkpoint.opened(tmp_path, OPTIONS) as checkpoints:
        assert list(checkpoints.all_steps()) == [1, 3, 4]
        last = checkpoint.restore(checkpoints, abstract)
        best = checkpoint.restore(checkpoints, abstract, best=True)
    assert last.notes == {"pairs": 40} and last.damaged == {}
    same(last.state, at(initial, 4))
    same(best.state, at(initial, 1))
    assert jax.tree.structure(last.state) == jax.tree.structure(initial)


def test_another_config_is_refused_by_name(tmp_path):
    with checkpoint.opened(tmp_path, OPTIONS):
        pass
    other = dataclasses.replace(OPTIONS, generator=GeneratorConfig(width=0.5))
    with pytest.raises(ValueError, match=r"generator.width: 0.0625 saved, 0.5 given"):
        with checkpoint.opened(tmp_path, other):
            pass


def test_unfinished_and_damaged_checkpoints_leave_the_one_before(tmp_path, initial, abstract):
    with checkpoint.opened(tmp_path, OPTIONS) as checkpoints:
        checkpoint.save(checkpoints, at(initial, 1), {})
        checkpoint.save(checkpoints, at(initial, 2), {})
    # As a killed run leaves it: Orbax renames a folder once it is complete.
    shutil.copytree(tmp_path / "2", tmp_path / "3.orbax-checkpoint-tmp-1")
    for path in (tmp_path / "2" / "state").rglob("*"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with checkpoint.opened(tmp_path, OPTIONS) as checkpoints:
        found = checkpoint.restore(checkpoints, abstract)
        assert list(found.damaged) == [2]
        same(found.state, at(initial, 1))
        shutil.rmtree(tmp_path / "1" / "state")
        with pytest.raises(ValueError, match=r"no checkpoint .* step 2: .* step 1: "):
            checkpoint.restore(checkpoints, abstract)


def _save_on_full_disk(folder):
    """Exits with 3 where saving raises; a limit on the size of files makes every larger write
    fail, as a full disk does."""
    abstract = jax.eval_shape(make_train(OPTIONS)[0], jax.random.key(0), _batch())
    state = at(_filled(abstract, 0), 3)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
    try:
        with checkpoint.opened(folder, OPTIONS) as checkpoints:
            checkpoint.save(checkpoints, state, {})
    except (OSError, ValueError):
        sys.exit(3)


def test_full_disk_leaves_the_checkpoint_before(tmp_path, initial, abstract):
    with checkpoint.opened(tmp_path, OPTIONS) as checkpoints:
        checkpoint.save(checkpoints, at(initial, 1), {})
        checkpoint.save(checkpoints, at(initial, 2), {})
    # In a process of its own: Orbax drops the writes it had not begun when one fails, and when they
    # are collected, in whatever test, that is a warning.
    process = multiprocessing.get_context("spawn").Process(
        target=_save_on_full_disk, args=(tmp_path,)
    )
    process.start()
    process.join()
    assert process.exitcode == 3
    with checkpoint.opened(tmp_path, OPTIONS) as checkpoints:
        found = checkpoint.restore(checkpoints, abstract)
    same(found.state, at(initial, 2))


@pytest.mark.parametrize(("norm", "dtype"), [("instance", "float32"), ("batch", "float16")])
def test_export_is_loaded_by_one_call(tmp_path, norm, dtype):
    options = TrainConfig(GeneratorConfig(width=0.0625, norm=norm), None)
    init, _ = make_train(options)
    abstract = jax.eval_shape(init, jax.random.key(1), _batch())
    variables = inference_variables(_filled(abstract, 1))
    card = {"command": "python -m x", "errors": {"rmse": 0.5}}
    path = tmp_path / "deep" / "height.npz"
    checkpoint.export(path, options.generator, variables, card, dtype)
    found = checkpoint.load(path)
    assert found.config == options.generator and found.card == card
    exact = {"float32": 0.0, "float16": 5e-4}[dtype]
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=exact, atol=1e-7 * (exact > 0)),
        found.variables,
        variables,
    )
    shape = jax.eval_shape(Generator(found.config).apply, found.variables, _batch().inputs).shape
    assert shape == (*SHAPE, 1)
    text = path.with_suffix(".md").read_text()
    assert "python -m x" in text and "rmse: 0.5" in text
    assert sorted(p.name for p in path.parent.iterdir()) == ["height.md", "height.npz"]


def test_export_refuses_what_is_not_finite_and_load_what_does_not_fit(tmp_path, initial):
    path = tmp_path / "height.npz"
    variables = inference_variables(initial)
    broken = jax.tree.map(lambda p: p * jnp.float32(np.nan), variables)
    with pytest.raises(ValueError, match="not finite in float32: params/decode1/kernel"):
        checkpoint.export(path, OPTIONS.generator, broken, {})
    assert not path.exists()
    checkpoint.export(path, GeneratorConfig(width=0.125), variables, {})
    with pytest.raises(ValueError, match=r"params/decode1/kernel: \(4, 4, 16, 8\) found"):
        checkpoint.load(path)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match="no exported generator, or is damaged"):
        checkpoint.load(path)
    header = np.asarray(json.dumps({"format": 99}))
    np.savez(path, __header__=header)
    with pytest.raises(ValueError, match="format 99: expected 1"):
        checkpoint.load(path)
    with pytest.raises(ValueError, match="expected a name in .npz"):
        checkpoint.export(tmp_path / "x.bin", OPTIONS.generator, variables, {})
