"""Errors of exported networks on the test pairs of a data set, beside the baselines.

python -m experiments.evaluate                                # what ships in checkpoints/
python -m experiments.evaluate --preset tiny --weights results/train_height/height.npz
python -m experiments.evaluate --weights checkpoints/color.npz --height checkpoints/height.npz
"""

import dataclasses
import functools
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments import evaluation, make_dataset, train_network, training
from experiments.common import helped, print_table, results_folder, timed, write_run
from experiments.evaluation import Pairs, Scale
from jaxbrush import batches, checkpoint, data
from jaxbrush.models import Generator, inputs_of

KINDS = {count: kind for kind, count in training.OUTPUTS.items()}
SHIPPED = Path("checkpoints")


@dataclasses.dataclass(frozen=True)
class Config:
    """Compares networks with the simulator on pairs that they have not learned from."""

    weights: tuple[Path, ...] = (SHIPPED / "height.npz", SHIPPED / "color.npz")
    """Exported networks, of height or color."""
    height: Path | None = None
    """A height network whose picture the color networks are given in place of the true height, as
    in use."""
    preset: Literal["tiny", "cpu", "small", "paper"] = "cpu"
    """Data set, made if it is not there."""
    data: Path | None = None
    """Folder of the data set [default: results/data_<preset>]."""
    split: Literal["test", "train"] = "test"
    """Pairs to judge by."""
    out: Path | None = None
    """Folder for pictures and numbers [default: results/evaluate]."""


def predicted(exported: checkpoint.Exported, pairs: Pairs) -> np.ndarray:
    """Pictures of a network for all pairs, (n, h, w, k) in network scale."""
    return evaluation.paint(exported.config, exported.variables, pairs.batch)


def with_height(pairs: Pairs, height) -> Pairs:
    """Color pairs whose last input, the new height, is another one, (n, h, w, 1)."""
    inputs = np.concatenate([np.asarray(pairs.batch.inputs)[..., :-1], height], -1)
    batch = dataclasses.replace(pairs.batch, inputs=jnp.asarray(inputs))
    return dataclasses.replace(pairs, batch=batch)


def milliseconds(nets: list[checkpoint.Exported], size: int) -> list[float]:
    """Least warm time [ms] of each network on one picture of size x size, taken in turns: one after
    the other, networks that are alike differed by 40 %, as the machine did."""
    calls = []
    for net in nets:
        channels = inputs_of(net.config, net.variables["params"])
        x = jnp.zeros((1, size, size, channels))
        call = jax.jit(lambda v, x, c=net.config: Generator(c).apply(v, x, x[..., :1]))
        calls.append(functools.partial(call, net.variables, x))
    turns = [[timed(call, repeats=1)[1].low for call in calls]]
    while len(turns) < 60 and np.sum(turns) < 5.0 * len(calls):
        turns.append([timed(call, repeats=1)[1].low for call in calls])
    return [1e3 * least for least in np.min(turns, axis=0).tolist()]


def main(options: Config) -> None:
    missing = [str(p) for p in (*options.weights, options.height) if p and not p.exists()]
    if missing:
        raise SystemExit(f"no such weights: {', '.join(missing)}")
    try:
        networks = [(path, checkpoint.load(path)) for path in options.weights]
        chained = options.height and checkpoint.load(options.height)
        found = data.load(make_dataset.build(options.preset, options.data))
    except ValueError as error:
        raise SystemExit(f"{error}") from error
    folder = results_folder("evaluate", options.out)
    index = np.arange(found.count(options.split))
    scale = Scale(batches.LEVELS["height"], found.options.pairs.paint.pixel)
    results = {}
    for path, exported in networks:
        kind = KINDS[exported.config.outputs]
        seen = train_network.Config(**exported.card.get("inputs", {}))
        pairs = train_network.pairs_of(found, options.split, index, kind, seen)
        try:
            pictures = predicted(exported, pairs)
        except ValueError as error:
            raise SystemExit(f"{path}: {error}") from error
        parts = evaluation.parts(kind, pictures, pairs)
        tables = {part: evaluation.compare(part, *each, scale) for part, each in parts.items()}
        if kind == "color" and chained and seen.height:
            laid = train_network.predicted_heights(found, options.split, index, chained)
            used = with_height(pairs, batches.network_height(laid))
            picture = predicted(exported, used)
            in_use = evaluation.errors(kind, picture, used.batch, scale)
            tables[kind] = {"on predicted height": in_use} | tables[kind]
        training.sample_grid(kind, pictures[:6], pairs[:6], folder / f"{path.stem}.png")
        side = found.options.pairs.size
        (spent,) = milliseconds([exported], side)
        results[str(path)] = {"errors": tables.get(kind, tables), "milliseconds": spent}
        for part, rows in tables.items():
            about = f"{part} of {len(index)} {options.split} pairs, {spent:.0f} ms for"
            print_table(f"{path}: {about} {side} x {side}", *evaluation.table(part, rows))
    write_run(folder, options, results)


if __name__ == "__main__":
    main(tyro.cli(Config, description=helped(__doc__)))
