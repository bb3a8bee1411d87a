"""Training states on disk, by Orbax, and exported weights of a generator: one file, one call."""

import dataclasses
import json
import os
from contextlib import contextmanager
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
from orbax.checkpoint import checkpoint_managers as policies

from jaxbrush import mixing
from jaxbrush.models import Generator, GeneratorConfig
from jaxbrush.structs import state

FORMAT = 1
"""Version of exported files."""
SCORE = "score"
"""Name, in the metrics of a checkpoint, of what is best when lowest."""
_CONFIG = "config.json"


def as_dict(options) -> dict:
    """A config as plain values, as JSON gives them back."""
    return json.loads(json.dumps(dataclasses.asdict(options)))


def differences(saved, given, name: str = "") -> list[str]:
    """Where two nested dicts differ, as lines "name: saved, given"."""
    if isinstance(saved, dict) and isinstance(given, dict):
        return [
            line
            for key in sorted(saved.keys() | given.keys())
            for line in differences(saved.get(key), given.get(key), f"{name}.{key}".lstrip("."))
        ]
    return [] if saved == given else [f"{name}: {saved!r} saved, {given!r} given"]


def replace_file(path: Path, data: bytes):
    """Writes a file under another name, forces it to disk and renames it: all of it or none."""
    partial = path.with_name(path.name + ".partial")
    with open(partial, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, path)


def _check_config(folder: Path, options):
    path = folder / _CONFIG
    given = as_dict(options)
    if not path.exists():
        replace_file(path, json.dumps(given, indent=1).encode() + b"\n")
        return
    lines = differences(json.loads(path.read_text()), given)
    if lines:
        raise ValueError(
            f"{folder} holds checkpoints of another configuration: {'; '.join(lines)}. Use the "
            "saved values or another folder."
        )


@contextmanager
def opened(folder, options):
    """Opens a folder of checkpoints, made if need be, and waits for what is being written at the
    end: `with opened(folder, config) as checkpoints`.

    The last two checkpoints are kept, so that one is left where the last turns out damaged, and
    the one with the lowest score.

    Args:
      options: config of the training, kept beside the checkpoints.

    Raises:
      ValueError: the folder's checkpoints are of another config; names the fields that differ.
    """
    folder = Path(folder).absolute()
    folder.mkdir(parents=True, exist_ok=True)
    _check_config(folder, options)
    keep = policies.AnyPreservationPolicy(
        [
            policies.LatestN(2),
            policies.BestN(
                get_metric_fn=lambda metrics: metrics[SCORE],
                reverse=True,
                n=1,
                keep_checkpoints_without_metrics=False,
            ),
        ]
    )
    settings = ocp.CheckpointManagerOptions(
        preservation_policy=keep,
        best_fn=lambda metrics: metrics[SCORE],
        best_mode="min",
        cleanup_tmp_directories=True,
    )
    manager = ocp.CheckpointManager(folder, options=settings)
    try:
        yield manager
        manager.wait_until_finished()
    finally:
        manager.close()


def save(checkpoints, state, notes: dict, score: float | None = None):
    """Saves a training state under its step, in the background; complete or not at all.

    Args:
      checkpoints: from `opened`. state: TrainState; may be donated as soon as this returns.
      notes: what else a run needs to go on, plain values. score: lowest is best.

    Raises:
      OSError, ValueError: this or an earlier one could not be written; those before remain.
    """
    items = ocp.args.Composite(state=ocp.args.StandardSave(state), notes=ocp.args.JsonSave(notes))
    metrics = None if score is None else {SCORE: float(score)}
    checkpoints.save(int(jax.device_get(state.step)), args=items, metrics=metrics, force=True)


@state
class Restored:
    """state: TrainState. notes: as saved. damaged: later steps that could not be read, with the
    reason."""

    state: object
    notes: dict = dataclasses.field(metadata={"static": True})
    damaged: dict[int, str] = dataclasses.field(metadata={"static": True})


def restore(checkpoints, abstract, best: bool = False) -> Restored | None:
    """The last training state that can be read, or the best.

    Args:
      checkpoints: from `opened`. abstract: shapes of the state, `jax.eval_shape(init, key, batch)`.
      best: the one with the lowest score in place of the last.

    Returns:
      Restored, bit for bit what was saved; None where there is no checkpoint.

    Raises:
      ValueError: there are checkpoints and none can be read; names each with its reason.
    """
    steps = sorted(checkpoints.all_steps(), reverse=True)
    if best and (first := checkpoints.best_step()) is not None:
        steps = [first]
    damaged = {}
    here = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    abstract = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=x.sharding or here), abstract
    )
    for step in steps:
        items = ocp.args.Composite(
            state=ocp.args.StandardRestore(abstract), notes=ocp.args.JsonRestore()
        )
        try:
            found = checkpoints.restore(step, args=items)
            return Restored(state=found["state"], notes=found["notes"], damaged=damaged)
        except Exception as error:  # Orbax raises many kinds for a damaged file
            damaged[step] = f"{type(error).__name__}: {str(error).splitlines()[0][:200]}"
    if damaged:
        reasons = "; ".join(f"step {step}: {reason}" for step, reason in damaged.items())
        raise ValueError(f"no checkpoint in {checkpoints.directory} can be read: {reasons}")
    return None


@state
class Exported:
    """variables: for `Generator(config).apply`. card: what made it, on what data, how good."""

    variables: dict
    config: GeneratorConfig
    card: dict = dataclasses.field(metadata={"static": True})


def _named(tree) -> dict[str, np.ndarray]:
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {"/".join(str(key.key) for key in path): np.asarray(leaf) for path, leaf in leaves}


def export(path, options: GeneratorConfig, variables: dict, card: dict, dtype: str = "float32"):
    """Writes a generator into one .npz file and its card beside it, as Markdown.

    Args:
      path: ends in .npz. variables: from `train.inference_variables`.
      card: name to plain value or text, such as command, data, steps, device, time, errors.
      dtype: "float32", or "float16" for half the size at a rounding of 5e-4.

    Raises:
      ValueError: another ending or dtype, or weights that are not finite.
    """
    path = Path(path)
    if path.suffix != ".npz" or dtype not in ("float32", "float16"):
        raise ValueError(f"{path} as {dtype!r}: expected a name in .npz, and float32 or float16")
    arrays = {name: value.astype(dtype) for name, value in _named(variables).items()}
    bad = [name for name, value in arrays.items() if not np.isfinite(value).all()]
    if bad:
        raise ValueError(f"weights that are not finite in {dtype}: {', '.join(bad)}")
    header = {"format": FORMAT, "config": as_dict(options), "card": card}
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    with open(partial, "wb") as file:
        np.savez(file, __header__=np.asarray(json.dumps(header)), **arrays)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, path)
    lines = [f"# {path.stem}", ""]
    for name, value in card.items():
        if isinstance(value, dict):
            lines += [f"- **{name}**:"] + [f"  - {key}: {v}" for key, v in value.items()]
        else:
            lines.append(f"- **{name}**: {value}")
    replace_file(path.with_suffix(".md"), ("\n".join(lines) + "\n").encode())


def load(path) -> Exported:
    """Reads an exported generator: `Generator(e.config).apply(e.variables, inputs)`.

    Raises:
      ValueError: a file that is none, of another format, or whose arrays do not fit its config.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(str(arrays.pop("__header__")))
        version = header["format"]
    except FileNotFoundError:
        raise
    except Exception as error:
        raise ValueError(f"{path} is no exported generator, or is damaged: {error}") from error
    if version != FORMAT:
        raise ValueError(f"{path} has format {version}: expected {FORMAT}")
    options = GeneratorConfig(**header["config"])
    kernel = arrays.get("params/encode1/kernel")
    channels = kernel.shape[2] if kernel is not None and kernel.ndim == 4 else 1
    shape = (1, 4, 4, channels + (mixing.COLORS if options.mixes else 0))
    expected = jax.eval_shape(
        lambda key: Generator(options).init(key, jnp.zeros(shape), jnp.ones((1, 4, 4, 1))),
        jax.random.key(0),
    )
    leaves, tree = jax.tree_util.tree_flatten_with_path(expected)
    names = ["/".join(str(key.key) for key in at) for at, _ in leaves]
    shapes = {name: leaf.shape for name, (_, leaf) in zip(names, leaves, strict=True)}
    found = {name: value.shape for name, value in arrays.items()}
    if found != shapes:
        lines = [
            f"{name}: {found.get(name)} found, {shapes.get(name)} expected"
            for name in sorted(found.keys() | shapes.keys())
            if found.get(name) != shapes.get(name)
        ]
        raise ValueError(f"{path} does not fit its config {options}: {'; '.join(lines)}")
    values = [jnp.asarray(arrays[name], jnp.float32) for name in names]
    return Exported(jax.tree.unflatten(tree, values), options, header["card"])
