"""What train_height and train_color are: data set, training, errors, pictures, weights. Also of one
network that paints both, for `experiments.single_or_twins`."""

import dataclasses
import sys
from pathlib import Path
from typing import Literal

import jax
import numpy as np

from experiments import evaluation, make_dataset, training
from experiments.common import console
from experiments.evaluation import Pairs, Scale
from jaxbrush import batches, checkpoint, data, stages

HELD = 5
"""Canvases of the training split, at most, that choose the best checkpoint and are not learned
from; the test split is seen once, at the end."""


INPUTS = ("hand", "time", "load", "tip", "film", "hair", "height", "mixes")
"""Options that say what a network is given."""


@dataclasses.dataclass(frozen=True)
class Config(training.Options):
    """Trains a network on a data set, which is made first if it is not there."""

    preset: Literal["tiny", "cpu", "small", "paper"] = "tiny"
    """Data set (see make_dataset)."""
    data: Path | None = None
    """Folder of the data set [default: results/data_<preset>]."""
    hand: Literal["pressure", "sweeps", "both"] = "both"
    """Height: what it is told of the hand: the pressure map (the paper's way), the sweep count (its
    Figure 3), or both."""
    time: bool = True
    """With the time map (paper Figure 4)."""
    load: bool = True
    """Height: with the load of the brush."""
    tip: bool = True
    """Height: with the height of the bristles' tips."""
    film: bool = True
    """Height: with the film that the stroke would leave if paint did not flow."""
    hair: bool = True
    """Height: with the hair that was in that film last."""
    height: bool = True
    """Color: with the new height (paper Figure 5)."""
    laid: Path | None = None
    """Color: exported height network. Every pair then comes twice, with the true new height and
    with this network's, which is what the color network is given in use."""


@dataclasses.dataclass(frozen=True)
class Stored:
    """Pairs that stay on disk until they are taken; what `training.run` learns from. laid: new
    heights (n, h, w, 1) [mm] of the same pairs, which come again with them."""

    found: data.Dataset
    index: np.ndarray
    kind: str
    options: Config
    laid: np.ndarray | None = None

    def __len__(self):
        return len(self.index) * (1 if self.laid is None else 2)

    @property
    def nbytes(self) -> int:
        one = self.take(np.arange(1))
        return len(self) * sum(x.nbytes for x in jax.tree.leaves(one))

    def take(self, index):
        which = np.asarray(index) % len(self.index)
        raw = self.found.take("train", self.index[which])
        if self.laid is not None:
            again = (np.asarray(index) >= len(self.index))[:, None, None, None]
            raw["new_height"] = np.where(again, self.laid[which], raw["new_height"])
        return jax.device_get(batch_of(raw, self.kind, self.options))


def batch_of(raw: dict, kind: str, options: Config):
    """Inputs, target and mask of a network, as the options ask for."""
    told = (options.hand, options.time, options.load, options.tip, options.film, options.hair)
    if kind == "height":
        return batches.height_batch(raw, *told)
    if kind == "single":
        return batches.single_batch(raw, options.mixes, *told)
    return batches.color_batch(raw, options.time, options.height, options.mixes)


def pairs_of(found: data.Dataset, split: str, index, kind: str, options: Config) -> Pairs:
    """Pairs of a data set in network scale."""
    raw = found.take(split, index)
    shown = batches.preview(raw)

    def pictures(height, color):
        parts = {"height": batches.network_height(height), "color": 2.0 * color - 1.0}
        both = np.concatenate([parts["color"], parts["height"]], -1)
        return np.asarray(parts.get(kind, both))

    background = pictures(raw["height"], raw["color"])
    preview = pictures(shown["new_height"], shown["new_color"])
    return Pairs(batch_of(raw, kind, options), background, preview)


_faded = jax.jit(jax.vmap(lambda cover: stages.faded(cover)[0]))


def predicted_heights(found: data.Dataset, split: str, index, exported) -> np.ndarray:
    """New heights of pairs as a height network lays them, (n, h, w, 1) [mm]."""
    given = Config(**exported.card.get("inputs", {}))
    pairs = pairs_of(found, split, index, "height", given)
    picture = evaluation.paint(exported.config, exported.variables, pairs.batch)
    laid = batches.LEVELS["height"] * 0.5 * (picture + 1.0)
    raw = found.take(split, index)
    share = np.asarray(_faded(batches.touched(raw)[..., 0].astype(np.float32)))[..., None]
    return (raw["height"] + share * (laid - raw["height"])).astype(np.float32)


def _laying(kind: str, options: Config):
    """The height network that the color network learns to follow, or None."""
    if options.laid is None:
        return None
    if kind != "color" or not options.height:
        raise ValueError("--laid: expected with train_color, and with --height, only")
    if not options.laid.exists():
        raise ValueError(f"--laid {options.laid}: no such file")
    exported = checkpoint.load(options.laid)
    if exported.config.outputs != 1:
        raise ValueError(f"--laid {options.laid}: expected a height network, of 1 output channel")
    return exported


def main(kind: str, options: Config) -> dict:
    """Makes the data set if need be, and trains; returns what `training.fit` does."""
    try:
        laying = _laying(kind, options)
        folder = make_dataset.build(options.preset, options.data)
        found = data.load(folder)
    except ValueError as error:
        raise SystemExit(f"{error}") from error
    strokes = found.options.pairs.strokes
    held = strokes * min(HELD, max(1, found.options.train // 10))
    numbers = np.arange(found.count("train"))
    known = numbers[:-held]
    laid = None if laying is None else predicted_heights(found, "train", known, laying)
    take = lambda split, index: pairs_of(found, split, index, kind, options)  # noqa: E731
    size, tests = found.options.pairs.size, found.count("test")
    about = (
        f"{options.preset}, seed {found.seed}: {len(numbers)} + {tests} pairs of {size} x {size}"
    )
    scale = Scale(batches.LEVELS["height"], found.options.pairs.paint.pixel)
    try:
        result = training.fit(
            options,
            kind,
            Stored(found, known, kind, options, laid),
            take("train", numbers[-held:]),
            take("test", np.arange(tests)),
            scale,
            data=about,
            inputs={name: getattr(options, name) for name in INPUTS},
            command=f"python -m experiments.train_{kind} {' '.join(sys.argv[1:])}".strip(),
        )
    except (ValueError, training.NotFinite) as error:
        raise SystemExit(f"{error}") from error
    where = options.out or Path("results") / f"train_{kind}"
    console.print(f"pictures: {where / 'samples.png'}   weights: {where / (kind + '.npz')}")
    return result
