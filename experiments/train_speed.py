"""How fast is a training step, what would its convolutions take alone, and what does PyTorch take?

The floor is the arithmetic of the convolutions as the paper's appendix states them, at the speed of
the largest float32 matrix product. PyTorch, where it is installed, runs the same networks and the
same step, once its losses agree.

    python -m experiments.train_speed            # some minutes
    python -m experiments.train_speed --quick    # about a minute
"""

import dataclasses
import gc
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import tyro

from experiments import train_torch
from experiments.common import (
    COLORS,
    console,
    helped,
    print_table,
    results_folder,
    save_figure,
    write_run,
)
from jaxbrush.models import DiscriminatorConfig, GeneratorConfig
from jaxbrush.train import Batch, TrainConfig, make_train

BAR = 1.3
# Multiply-adds a pixel of the input picture: kernel 4 x 4, inputs, outputs, share of the pixels.
DECODER = ((256, 128, 1 / 4), (256, 128, 1 / 4), (256, 64, 1), (128, "k", 1))
ENCODER = (("c", 64, 1), (64, 128, 1 / 4), (128, 128, 1 / 4), (128, 256, 1 / 16))
JUDGE = (
    ("ck", 64, 1),
    (64, 128, 1 / 4),
    (128, 256, 1 / 16),
    (256, 512, 1 / 16),
    (512, "one", 1 / 16),
)


@dataclasses.dataclass(frozen=True)
class Config:
    """Speed of the training step."""

    out: Path | None = None
    """Folder for chart and numbers [default: results/train_speed]."""
    quick: bool = False
    """Half width, 64 pixels: the same code in about a minute."""
    sizes: tuple[int, ...] = (64, 128, 192, 256)
    """Sides of the pictures [px]."""
    width: float = 1.0
    """Factor on the channels of both networks."""
    rounds: int = 5
    """Warm steps of each, in turn; the minimum and the median are kept."""
    channels: int = 2
    """Of the inputs: 2 for height."""
    torch: bool = True
    """Times PyTorch beside it, if it is installed."""


def multiply_adds(width: float, channels: int, outputs: int, folded: bool = False) -> float:
    """Of one training step, for each pixel of the picture.

    A generator pass forward and two back (to its inputs and its kernels; the first layer needs no
    slope of its inputs), the discriminator forward on two pictures, back to kernels and inputs for
    both, and back to inputs once more for the generator's loss.

    Args:
      folded: upsampling as 36 products in place of 64, as it is computed here.
    """

    given = {"c": channels, "ck": channels + outputs, "k": outputs, "one": 1}

    def count(x):
        return given[x] if isinstance(x, str) else max(1, round(width * x))

    def layer(ins, outs, share):
        return 16 * count(ins) * count(outs) * share

    total = 0.0
    for index, one in enumerate(ENCODER + DECODER):
        up = index in (4, 6)  # the two layers that double the size
        total += layer(*one) * (2 if index == 0 else 3) * (36 / 64 if folded and up else 1.0)
    for index, one in enumerate(JUDGE):
        # 2 forward, 2 to kernels, 2 to inputs (not of the first layer), 1 to inputs for the other.
        total += layer(*one) * (5 if index == 0 else 7)
    return total


def peak_flops() -> float:
    """Operations per second of a float32 matrix product, now."""
    size = 1536
    a = jnp.ones((size, size), jnp.float32)
    product = jax.jit(lambda x: jnp.matmul(x, x, precision=jax.lax.Precision.HIGHEST))
    product(a).block_until_ready()
    best = np.inf
    for _ in range(3):
        start = _clock()
        product(a).block_until_ready()
        best = min(best, _clock() - start)
    return 2 * size**3 / best


def _clock() -> float:
    # On one core, the time of this process: other processes on that core do not count.
    return time.process_time() if train_torch.cores() == 1 else time.perf_counter()


def random_batch(side: int, channels: int) -> Batch:
    rng = np.random.default_rng(0)
    inputs = rng.uniform(-1, 1, (1, side, side, channels)).astype(np.float32)
    target = np.tanh(inputs.sum(-1, keepdims=True))
    return Batch(inputs, target, np.ones_like(target))


def make_steps(options: Config, side: int):
    """Name to (function of one step that returns the losses, seconds of the first)."""
    batch = random_batch(side, options.channels)
    init, update = make_train(
        TrainConfig(GeneratorConfig(width=options.width), DiscriminatorConfig(width=options.width))
    )
    device = jax.devices()[0]
    held = [jax.device_put(init(jax.random.key(0), batch), device)]
    on_device = jax.device_put(batch, device)
    parameters = jax.device_get((held[0].generator, held[0].discriminator))

    def ours():
        held[0], metrics = update(held[0], on_device)
        jax.block_until_ready(held[0])
        return {name: float(metrics[name]) for name in ("l1", "gan", "discriminator")}

    steps = {"jaxbrush": ours}
    if options.torch and train_torch.available():
        steps["PyTorch"] = train_torch.make_step(parameters, batch)
    return steps


def measure(options: Config, side: int) -> dict:
    """Times of a step [s] of all in turn, with the peak taken between."""
    steps = make_steps(options, side)
    first, losses = {}, {}
    for name, step in steps.items():
        start = time.perf_counter()
        losses[name] = [step()]
        first[name] = time.perf_counter() - start
    taken, peaks = {name: [] for name in steps}, []
    for _ in range(options.rounds):
        peaks.append(peak_flops())
        for name, step in steps.items():
            start = _clock()
            losses[name].append(step())
            taken[name].append(_clock() - start)
    flops = 2 * side**2 * multiply_adds(options.width, options.channels, 1)
    folded = 2 * side**2 * multiply_adds(options.width, options.channels, 1, folded=True)
    out = {
        "side": side,
        "flops": flops,
        "flops_folded": folded,
        "peak": max(peaks),
        "floor": flops / max(peaks),
        "floor_folded": folded / max(peaks),
        "first": first,
        "low": {name: min(t) for name, t in taken.items()},
        "median": {name: float(np.median(t)) for name, t in taken.items()},
        "losses": losses,
    }
    if "PyTorch" in losses:
        pairs = zip(losses["jaxbrush"][:2], losses["PyTorch"][:2], strict=True)
        out["apart"] = max(abs(a[k] - b[k]) / abs(a[k]) for a, b in pairs for k in a)
    return out


def chart(found: list[dict], path: Path):
    figure, axes = plt.subplots(figsize=(6.4, 4.2))
    sides = [row["side"] for row in found]
    for color, name in zip(COLORS, found[0]["low"], strict=False):
        axes.plot(sides, [row["low"][name] for row in found], "o-", color=color, label=name)
    floor = np.array([row["floor"] for row in found])
    axes.plot(sides, floor, color="0.3", label="the appendix's convolutions at peak")
    axes.fill_between(sides, floor, BAR * floor, color="0.85", label=f"within {BAR} of it")
    folded = [row["floor_folded"] for row in found]
    axes.plot(sides, folded, ":", color="0.3", label="the same, upsampling folded")
    axes.set(xscale="log", yscale="log", xlabel="side of the picture [px]",
             ylabel="time per step [s]", title="A training step")  # fmt: skip
    axes.set_xticks(sides, sides)
    axes.minorticks_off()
    axes.legend()
    save_figure(figure, path)


def main(options: Config):
    if options.quick:
        options = dataclasses.replace(options, sizes=(64,), width=0.5, rounds=3)
    folder = results_folder("train_speed", options.out)
    if options.torch and not train_torch.available():
        console.print("PyTorch is not installed here: its times are left out (pip install torch).")
    found = []
    for side in options.sizes:
        found.append(measure(options, side))
        gc.collect()
        console.print(f"{side} px: {found[-1]['low']}")
        write_run(folder, options, {"steps": found})
    chart(found, folder / "train_speed.png")
    rows = []
    for row in found:
        for name, low in row["low"].items():
            rows.append(
                [f"{row['side']} px, {name}", f"{1e3 * low:.0f}",
                 f"{1e3 * row['median'][name]:.0f}", f"{1e3 * row['floor']:.0f}",
                 f"{low / row['floor']:.2f}",
                 f"{low / row['floor_folded']:.2f}", f"{row['peak'] / 1e9:.0f}",
                 f"{row['first'][name]:.1f}"]
            )  # fmt: skip
        if "apart" in row:
            console.print(f"{row['side']} px: losses of two steps agree to {row['apart']:.1e}")
    columns = ["step", "low [ms]", "median [ms]", "floor [ms]", f"over floor (bar {BAR})",
               "over folded", "peak [GFLOP/s]", "first call [s]"]  # fmt: skip
    cores = train_torch.cores()
    print_table(f"Training step, width {options.width}, float32, {cores} core(s)", columns, rows)


if __name__ == "__main__":
    main(tyro.cli(Config, description=helped(__doc__)))
