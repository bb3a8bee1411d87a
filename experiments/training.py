"""The loop that trains a network and reports on it: what train_height and train_color share."""

import dataclasses
import json
import os
import time
import zlib
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from experiments import evaluation, feed
from experiments.common import console, print_table, results_folder, write_run
from experiments.evaluation import Pairs, Scale
from jaxbrush import checkpoint
from jaxbrush.models import DiscriminatorConfig, GeneratorConfig, folded, inputs_of
from jaxbrush.train import TrainConfig, TrainParams, inference_variables, make_params, make_train

OUTPUTS = {"height": 1, "color": 3, "single": 4}
"""Channels of the networks; the single one paints color and height (paper Figure 6)."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Training of one network."""

    out: Path | None = None
    """Folder for checkpoints, pictures and numbers [default: results/train_KIND]."""
    steps: int | None = None
    """Updates in all, those before a resume included."""
    minutes: float | None = 5.5
    """Time for training in this run, compilation included."""
    resume: bool = False
    """Goes on from the last checkpoint in the folder; without one, starts."""
    start: Path | None = None
    """Exported weights to begin from. Of a network with instance normalisation, `--norm none` takes
    over the moments that it has on average (`models.folded`)."""
    batch: int = 1
    """Pairs an update sees."""
    width: float = 0.25
    """Factor on the generator's channels; 1 is the paper's."""
    discriminator_width: float = 0.25
    """Factor on the discriminator's channels."""
    norm: str = "instance"
    """instance, batch, masked or none."""
    upsampling: str = "resize"
    """resize or transposed."""
    bf16: bool = False
    """Convolutions in bfloat16."""
    l1: float = 10.0
    """Weight of the L1 loss."""
    gan: float = 0.02
    """Weight of the cGAN loss; 0 leaves the discriminator out. At the paper's 1 the discriminator
    wins within 2,000 steps of 1e-3, and its slope outweighs that of L1 by 15; at 0.1 within
    10,000."""
    l2: float | None = None
    """Weight of the mean squared difference [default: 200; of color networks 0]."""
    opacity: float = 20.0
    """Heights: weight of the difference of the light that comes through."""
    gradient: float = 200.0
    """Heights: weight of the squared difference of their gradients."""
    rate: float = 1e-3
    """Adam's learning rate of the generator."""
    discriminator_rate: float = 1e-4
    """Adam's learning rate of the discriminator."""
    fall: float = 1.0
    """Share of the run, of its steps or minutes, in which both rates fall to 0 at its end."""
    average: bool = True
    """Evaluates and exports a running average of the parameters: on the tiny data set a masked
    error of 0.138 in place of 0.148."""
    check_every: int = 200
    """Updates between checkpoints, each with its error on held-out pairs and sample pictures."""
    log_every: int = 10
    """Updates between lines of metrics.jsonl; each is a mean over them."""
    turns: bool = True
    """Mirrors and turns pairs at random, by quarters."""
    mixes: bool = True
    """Color: the network says how much of which paint is seen, in place of a color as the paper's
    does."""
    recolor: bool = True
    """Color, of a network that does not mix: changes the colors of every pair at random, as paint
    allows (`batches.recolored`)."""
    resident: float = 4.0
    """Training pairs of up to so many GB are kept on the device, more are streamed."""
    seed: int = 0
    """Of the initial parameters and of the order of pairs."""


class NotFinite(RuntimeError):
    """A training that produced something that is not finite; says where to go on from."""


RUNGS = 64
"""The falling rates change so many times: an update's parameters need not travel every time."""


def falling(fall: float, spent: float) -> float:
    """Factor on the learning rates when a share of the run is spent, in steps of 1 / `RUNGS`."""
    rung = np.floor(RUNGS * min(spent, 1.0)) / RUNGS
    return float(np.clip((1.0 - rung) / max(fall, 1e-9), 0.5 / RUNGS, 1.0))


def train_config(options: Options, kind: str) -> TrainConfig:
    """The networks that the options ask for."""
    dtype = "bfloat16" if options.bf16 else "float32"
    norm = options.norm
    # The discriminator is thrown away, so it may see as far as it likes.
    opposed = "instance" if norm == "none" else norm
    judge = DiscriminatorConfig(options.discriminator_width, opposed, dtype)
    return TrainConfig(
        GeneratorConfig(
            OUTPUTS[kind], options.width, norm, options.upsampling, dtype, feed.mixes(options, kind)
        ),
        judge if options.gan > 0.0 else None,
        options.average,
    )


def train_params(options: Options, kind: str, factor: float = 1.0) -> TrainParams:
    """The weights of losses that the options ask for, and a factor of their learning rates."""
    l2 = options.l2
    if l2 is None:
        l2 = 0.0 if kind == "color" else 200.0
    rates = (factor * options.rate, factor * options.discriminator_rate)
    return make_params(
        options.l1, options.gan, *rates, l2=l2, opacity=options.opacity, gradient=options.gradient
    )


def sample_grid(kind: str, found, pairs: Pairs, path: Path):
    """Saves a row a pair: background, preview of the stroke, network, truth, difference times 4; of
    a network for color and height first those of one, then of the other."""
    tiles = []
    for picture, part in evaluation.parts(kind, found, pairs).values():
        truth = np.asarray(part.batch.target)
        difference = np.abs(np.asarray(picture) - truth) * 4.0 - 1.0
        for column in (part.background, part.preview, picture, truth, difference):
            column = np.clip(0.5 * (np.asarray(column) + 1.0), 0.0, 1.0)
            column = np.pad(column, ((0, 0), (2, 2), (2, 2), (0, 0)), constant_values=1.0)
            column = np.concatenate(list(column), axis=0)
            tiles.append(np.broadcast_to(column, (*column.shape[:2], 3)))
    sheet = (255.0 * np.concatenate(tiles, axis=1) + 0.5).astype(np.uint8)
    coded, data = cv2.imencode(".png", sheet[..., ::-1])
    if not coded:
        raise ValueError(f"{path}: a sheet of {sheet.shape} cannot be coded")
    checkpoint.replace_file(path, data.tobytes())


class _Log:
    """metrics.jsonl: means of the metrics of some updates, a line each."""

    def __init__(self, path: Path, every: int, step: int):
        kept = []
        if path.exists():  # lines after the checkpoint that a run goes on from come again
            lines = path.read_text().splitlines()
            kept = [
                line for line in lines if line.endswith("}") and json.loads(line)["step"] < step
            ]
        self.file = open(path, "w")
        self.file.writelines(line + "\n" for line in kept)
        self.every, self.parts = every, []

    def add(self, step: int, metrics: dict):
        self.parts.append(metrics)
        if (step + 1) % self.every == 0:
            means = {k: float(np.mean([m[k] for m in self.parts])) for k in metrics}
            self.write(step, means)
            self.parts = []

    def write(self, step: int, values: dict):
        self.file.write(json.dumps({"step": step, **values}) + "\n")
        self.file.flush()


LOOK = 128
"""Pairs at most that moments are taken from."""


def _begun(options: Options, state, wanted: GeneratorConfig, pairs: Pairs):
    """The state with the exported weights that the options name."""
    have = checkpoint.load(options.start)
    config, variables = have.config, have.variables
    if (config.norm, wanted.norm) == ("instance", "none"):
        index = np.linspace(0, len(pairs) - 1, min(LOOK, len(pairs))).astype(int)
        pictures = (pairs.take(some).inputs for some in np.array_split(index, -(-len(index) // 8)))
        config, variables = folded(config, variables, pictures)
    lines = checkpoint.differences(checkpoint.as_dict(config), checkpoint.as_dict(wanted))
    inputs = [
        inputs_of(c, p) for c, p in ((config, variables["params"]), (wanted, state.generator))
    ]
    if inputs[0] != inputs[1]:
        lines.append(f"inputs: {inputs[0]} saved, {inputs[1]} given")
    if lines:
        raise ValueError(f"{options.start}: is of another network: {'; '.join(lines)}")
    params = jax.tree.map(jnp.asarray, variables["params"])
    average = None if state.average is None else jax.tree.map(jnp.copy, params)
    moments = {k: v for k, v in variables.items() if k != "params"}
    return dataclasses.replace(state, generator=params, moments=moments, average=average)


def _start(init, params, pairs: Pairs, options: Options, chosen: TrainConfig, checkpoints):
    """(state, notes): from the last checkpoint that can be read, or new."""
    few = jax.tree.map(jnp.asarray, pairs.take(np.arange(options.batch)))
    key = jax.random.key(options.seed)
    # Whole numbers, so that no rounding of a device changes them.
    first = np.round(32767.5 * (np.nan_to_num(few.target) + 1.0)).astype(np.uint16)
    notes = {
        "seed": options.seed, "batch": options.batch, "pairs": len(pairs),
        "checksum of the first pairs": zlib.crc32(first.tobytes()),
    }  # fmt: skip
    folder = checkpoints.directory
    if not options.resume and checkpoints.all_steps():
        raise ValueError(f"{folder} has checkpoints: resume them, or use another folder")
    found = None
    if options.resume:
        found = checkpoint.restore(checkpoints, jax.eval_shape(init, key, few, params))
    if found is None:
        state = init(key, few, params)
        if options.start is not None:
            state = _begun(options, state, chosen.generator, pairs)
        # On a named device, as a restored state is: one compilation serves both.
        return jax.device_put(state, jax.devices()[0]), notes
    for step, reason in found.damaged.items():
        console.print(f"[yellow]checkpoint {step} cannot be read and is passed over:[/] {reason}")
        checkpoints.delete(step)
    lines = checkpoint.differences(found.notes, notes)
    if lines:
        raise ValueError(f"{folder}: this run would see other pairs: {'; '.join(lines)}")
    state = dataclasses.replace(found.state, params=jax.device_put(params, jax.devices()[0]))
    return state, notes


def run(options: Options, kind: str, train: Pairs, held: Pairs, folder: Path):
    """Trains until the budget of steps or minutes is spent.

    Args:
      kind: "height" or "color". train: pairs to learn from. held: a few others, whose masked error
        chooses the best checkpoint.

    Returns:
      (TrainConfig, state of the best checkpoint, dict of numbers about the run).

    Raises:
      NotFinite: names the step, the pairs it saw and the last good checkpoint.
      ValueError: neither steps nor minutes, or a folder whose checkpoints are of something else.
    """
    if options.steps is None and options.minutes is None:
        raise ValueError("steps = None, minutes = None: expected one of them")
    began = time.perf_counter()
    chosen = train_config(options, kind)
    init, update = make_train(chosen)
    params = train_params(options, kind)
    batches = feed.make_batches(train, options, kind)
    held = jax.device_put(held)
    seconds = np.inf if options.minutes is None else 60.0 * options.minutes
    last_step = np.inf if options.steps is None else options.steps

    with checkpoint.opened(folder / "checkpoints", chosen) as checkpoints:
        state, notes = _start(init, params, train, options, chosen, checkpoints)
        step = first = int(jax.device_get(state.step))
        used = 1.0  # factor on the rates
        log = _Log(folder / "metrics.jsonl", options.log_every, step)
        pending = None  # metrics of the update before: read late, so that the device never waits

        def spent(step):
            return max((time.perf_counter() - began) / seconds, step / last_step)

        def read(pending, bar, task):
            at, index, metrics = pending
            metrics = {k: float(v) for k, v in jax.device_get(metrics).items()}
            if not metrics.pop("finite"):
                checkpoints.wait_until_finished()
                good = checkpoints.latest_step()
                start = "there is no checkpoint yet"
                if good is not None:
                    start = f"the last good checkpoint is {checkpoints.directory / str(good)}"
                raise NotFinite(
                    f"step {at} is not finite: {metrics}, on pairs {index.tolist()}; {start}"
                )
            log.add(at, metrics)
            text = " ".join(
                f"{k} {metrics[k]:.3f}" for k in ("l1", "gan", "accuracy") if k in metrics
            )
            bar.update(task, completed=min(spent(at + 1), 1.0), text=f"step {at + 1}  {text}")

        def check():
            variables = inference_variables(state)
            found = evaluation.paint(chosen.generator, variables, held.batch)
            error = found - jax.device_get(held.batch.target)
            mask = jax.device_get(held.batch.mask)
            score = float(np.sqrt(np.sum(mask * error**2) / max(mask.sum() * error.shape[-1], 1.0)))
            checkpoint.save(checkpoints, state, notes, score)
            log.write(step - 1, {"held_rmse_masked": score})
            sample_grid(kind, found[:4], held[:4], folder / "samples" / f"{step:07d}.png")

        (folder / "samples").mkdir(parents=True, exist_ok=True)
        columns = [TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn(),
                   TextColumn("{task.fields[text]}")]  # fmt: skip
        with Progress(*columns, console=console) as bar:
            task = bar.add_task(f"train {kind}", total=1.0, text="compiling")
            looped = time.perf_counter()
            while step < last_step and time.perf_counter() - began < seconds:
                batch, index = batches(step)
                factor = falling(options.fall, spent(step))
                if factor != used:
                    slower = jax.device_put(train_params(options, kind, factor), jax.devices()[0])
                    state, used = dataclasses.replace(state, params=slower), factor
                state, metrics = update(state, batch)
                if pending is not None:
                    read(pending, bar, task)
                pending = (step, index, metrics)
                step += 1
                if step == first + 1:
                    jax.block_until_ready(state)
                    looped = time.perf_counter()
                if step % options.check_every == 0:
                    read(pending, bar, task)
                    pending = None
                    check()
            if pending is not None:
                read(pending, bar, task)
            trained = time.perf_counter()
            if step not in checkpoints.all_steps():
                check()
        checkpoints.wait_until_finished()
        log.file.close()
        few = jax.tree.map(jnp.asarray, train.take(np.arange(options.batch)))
        abstract = jax.eval_shape(init, jax.random.key(0), few, params)
        best = checkpoint.restore(checkpoints, abstract, best=True)
        best = state if best is None else best.state
    numbers = {
        "steps": step,
        "best_step": int(jax.device_get(best.step)),
        "seconds": time.perf_counter() - began,
        "seconds_per_step": (trained - looped) / max(step - first - 1, 1),
    }
    return chosen, best, numbers


def fit(
    options: Options, kind: str, train: Pairs, held: Pairs, test: Pairs, scale: Scale,
    data: str = "", command: str = "", inputs: dict | None = None,
) -> dict:  # fmt: skip
    """Trains a network, compares it with the baselines on the test pairs, prints the table, and
    leaves in the folder: checkpoints/, samples/, metrics.jsonl, config.json, metrics.json, and the
    weights with their card as KIND.npz, KIND.md.

    Args:
      train, held, test: see `run`; no stroke is in two of them.
      scale: of heights and pixels. data, command, inputs: for the card; from the last, `evaluate`
        knows what the network is given.

    Returns:
      What metrics.json holds: numbers of the run and, under "errors", those of `compare`, of a
      single network those of "height" and "color".

    Raises:
      as `run`.
    """
    folder = results_folder(f"train_{kind}", options.out)
    chosen, state, numbers = run(options, kind, train, held, folder)
    variables = inference_variables(state)
    found = evaluation.paint(chosen.generator, variables, test.batch)
    parts = evaluation.parts(kind, found, test)
    tables = {part: evaluation.compare(part, *each, scale) for part, each in parts.items()}

    def of(row):
        rows = {part: table[row] for part, table in tables.items()}
        return rows.get(kind, rows)

    sample_grid(kind, found[:6], test[:6], folder / "samples.png")
    card = {
        "command": command,
        "data": data,
        "inputs": inputs or {},
        "pairs": f"{len(train)} for training, {len(test)} for the errors",
        "steps": numbers["best_step"],
        "device": f"{jax.devices()[0]}, {os.cpu_count()} cores",
        "seconds": round(numbers["seconds"], 1),
        "errors (network scale unless said otherwise)": of("the network"),
        "errors of copying the background": of("copy the background"),
        "errors of the preview stroke": of("the preview stroke"),
    }
    checkpoint.export(folder / f"{kind}.npz", chosen.generator, variables, card)
    numbers = {"kind": kind, **numbers, "errors": tables.get(kind, tables)}
    write_run(folder, options, numbers)
    for part, rows in tables.items():
        names, texts = evaluation.table(part, rows)
        done = f"{numbers['steps']} steps, best {numbers['best_step']}, {len(test)} test pairs"
        print_table(f"{part}: {done}", names, texts, marked=0)
    return numbers
