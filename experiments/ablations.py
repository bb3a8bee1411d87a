"""What each part of the networks is worth: the default and its variants, trained alike.

Every variant is trained from nothing on the same pairs for the same number of updates (or minutes),
and charted by its error on test pairs against the time it takes to paint one. The default comes
again with another seed: differences smaller than that are noise. Variants that are done are not
trained again. A sheet shows the same strokes by all of them.

python -m experiments.ablations                        # height, about 5 minutes a variant
python -m experiments.ablations --kind color --steps 4000
python -m experiments.ablations --only default "width 1/2" "width 1/8" --minutes 10
"""

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Literal

import jax
import matplotlib.pyplot as plt
import numpy as np
import tyro
from matplotlib.ticker import LogLocator, NullFormatter

from experiments import evaluate, make_dataset, train_network
from experiments.common import (
    COLORS,
    INK,
    console,
    helped,
    label_points,
    print_table,
    results_folder,
    save_figure,
    write_run,
)
from jaxbrush import batches, checkpoint, data
from jaxbrush.canvas import Canvas, from_srgb
from jaxbrush.render import picture, shade

SIDE = 128
"""Of the picture whose time is taken [pixels]."""
LOOK = 3
"""Test pairs on the sheet."""
_BOTH = {
    "another seed": {"seed": 1},
    "width 1/8": {"width": 0.125},
    "width 1/2": {"width": 0.5},
    "no discriminator": {"gan": 0.0},
    "the paper's 10 L1 : 1 cGAN": {"gan": 1.0, "l2": 0.0, "opacity": 0.0, "gradient": 0.0},
    "cGAN alone": {"l1": 0.0, "gan": 1.0, "l2": 0.0, "opacity": 0.0, "gradient": 0.0},
    "transposed convolution": {"upsampling": "transposed"},
    "no instance normalisation": {"norm": "none"},
    "no time map": {"time": False},
}
VARIANTS = {
    "height": _BOTH | {
        "L1 alone, of heights": {"l2": 0.0, "opacity": 0.0, "gradient": 0.0},
        "no difference of the light": {"opacity": 0.0},
        "no difference of gradients": {"gradient": 0.0},
        "no load": {"load": False},
        "no height of the tips": {"tip": False},
        "no film": {"film": False},
        "no hair in the film": {"hair": False},
        "no sweep count": {"hand": "pressure"},
        "no pressure": {"hand": "sweeps"},
        "the paper's maps": {
            "hand": "pressure", "time": False, "load": False, "tip": False, "film": False,
            "hair": False,
        },
    },
    "color": _BOTH | {
        "mean squares, too": {"l2": 200.0},
        "no new height": {"height": False},
        "a color, not shares": {"mixes": False},
        "a color, not recolored": {"mixes": False, "recolor": False},
    },
}  # fmt: skip
"""What each changes of the default."""


@dataclasses.dataclass(frozen=True)
class Config:
    """The default network and its variants, trained alike."""

    kind: Literal["height", "color"] = "height"
    """Which network."""
    preset: Literal["tiny", "cpu", "small", "paper"] = "tiny"
    """Data set (see make_dataset)."""
    data: Path | None = None
    """Folder of the data set [default: results/data_<preset>]."""
    steps: int | None = 2000
    """Updates of each."""
    minutes: float | None = None
    """Minutes of each, in place of updates."""
    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    """Variants by name [default: all of them]."""
    out: Path | None = None
    """Folder [default: results/ablations_<kind>]."""
    quick: bool = False
    """Two variants and 20 updates: the same code."""


def chosen(options: Config) -> dict[str, dict]:
    """Variants by name, the default first.

    Raises:
      SystemExit: a name that is none.
    """
    known = {"default": {}} | VARIANTS[options.kind]
    names = options.only or tuple(known)
    for name in names:
        if name not in known:
            raise SystemExit(f"--only {name}: expected names among {', '.join(known)}")
    if options.quick:
        names = names[:2]
    return {name: known[name] for name in names}


def place(folder: Path, name: str) -> Path:
    """The folder of a variant."""
    return folder / name.replace("/", "_")


def options_of(options: Config, folder: Path, name: str, changes: dict) -> train_network.Config:
    """How a variant is trained."""
    steps = None if options.minutes is not None else options.steps
    return train_network.Config(
        **changes, preset=options.preset, data=options.data, out=place(folder, name),
        steps=20 if options.quick else steps, minutes=None if options.quick else options.minutes,
        check_every=10 if options.quick else 500,
    )  # fmt: skip


def _done(how: train_network.Config) -> dict | None:
    """What a variant came to, if it was trained like this before."""
    try:
        config = json.loads((how.out / "config.json").read_text())
        found = json.loads((how.out / "metrics.json").read_text())
    except (OSError, ValueError):
        return None
    same = json.loads(json.dumps(dataclasses.asdict(how), default=str))
    return found if config == same else None


def trained(kind: str, how: train_network.Config, title: str) -> dict:
    """What a network came to; trains it, unless it was trained like this before.

    Raises:
      SystemExit: a folder with a network that was trained in another way.
    """
    found = _done(how)
    if found is not None:
        return found
    console.print(title)
    if (how.out / "metrics.json").exists():
        raise SystemExit(f"{how.out}: was trained in another way; use another --out")
    resumed = dataclasses.replace(how, resume=(how.out / "checkpoints").exists())
    found = train_network.main(kind, resumed)
    write_run(how.out, how, found)
    return found


def in_light(height, color, pixel: float) -> np.ndarray:
    """Pictures (n, h, w, 3) uint8 of heights (n, h, w) [mm] and sRGB colors (n, h, w, 3)."""
    lit = jax.vmap(lambda h, c: shade(Canvas(h, from_srgb(c)), pixel))(height, color)
    return np.stack([picture(x) for x in lit])


def sheet(kind: str, nets: dict[str, checkpoint.Exported], found: data.Dataset, path: Path):
    """The same strokes by simulator and variants, in light; of height networks in true color, of
    color networks on true height (paper Figures 3, 4, 5, 8 and 11)."""
    index = np.linspace(0, found.count("test") - 1, LOOK).astype(int)
    raw = found.take("test", index)
    pixel, level = found.options.pairs.paint.pixel, batches.LEVELS["height"]

    def lit(change):
        seen = raw | change
        strip = in_light(seen["new_height"][..., 0], seen["new_color"], pixel)
        return np.concatenate(list(strip), axis=1)

    before = {"new_height": raw["height"], "new_color": raw["color"]}
    cells = {"before": lit(before), "simulator": lit({})}
    for name, net in nets.items():
        seen = train_network.Config(**net.card["inputs"])
        pairs = train_network.pairs_of(found, "test", index, kind, seen)
        laid = 0.5 * (evaluate.predicted(net, pairs) + 1.0)
        cells[name] = lit({"new_height": level * laid} if kind == "height" else {"new_color": laid})
    across = 3
    down = -(-len(cells) // across)
    figure, axes = plt.subplots(down, across, figsize=(3.9 * across, 1.45 * down))
    for axis in axes.flat:
        axis.axis("off")
    for axis, (name, cell) in zip(axes.flat, cells.items(), strict=False):
        axis.imshow(cell)
        axis.set_title(name, fontsize=8)
    save_figure(figure, path)


def chart(kind: str, rows: list[dict], path: Path):
    """Errors by name, and against the time to paint, where those that take the default's time have
    no names."""
    figure, (ranks, costs) = plt.subplots(1, 2, figsize=(10.0, 4.8), width_ratios=(1.3, 1.0))
    rows = sorted(rows, key=lambda row: -row["masked"])
    noise = [r["masked"] for r in rows if r["name"] in ("default", "another seed")]
    if len(noise) == 2:
        ranks.axvspan(min(noise), max(noise), color=COLORS[0], alpha=0.15, lw=0)
        costs.axhspan(min(noise), max(noise), color=COLORS[0], alpha=0.15, lw=0)
    usual = next((r["ms"] for r in rows if r["name"] == "default"), None)
    labels = []
    for rank, row in enumerate(rows):
        own = row["name"] == "default"
        style = {"ms": 8 if own else 5, "color": COLORS[0 if own else 1]}
        ranks.plot(row["masked"], rank, "o", **style)
        costs.plot(row["ms"], row["masked"], "o", **style)
        if own or usual is None or not 0.75 < row["ms"] / usual < 1.33:
            labels.append((row["name"], (row["ms"], row["masked"]), {"fontsize": 8, "color": INK}))
    ranks.set_yticks(range(len(rows)), [row["name"] for row in rows], fontsize=8)
    ranks.set_xlabel("RMSE in the mask, network scale")
    costs.set_xscale("log")
    costs.margins(x=0.3)
    costs.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    costs.xaxis.set_major_formatter("{x:g}")
    costs.xaxis.set_minor_formatter(NullFormatter())
    costs.set_xlabel(f"time to paint {SIDE} x {SIDE} pixels [ms]")
    costs.set_ylabel("RMSE in the mask, network scale")
    costs.set_title("without a name: about the default's time", fontsize=9, color=INK)
    figure.suptitle(f"{kind}: what each part is worth; the band is another seed")
    label_points(costs, labels)
    save_figure(figure, path)


def main(options: Config) -> None:
    variants = chosen(options)
    folder = results_folder(f"ablations_{options.kind}", options.out)
    rows, nets = [], {}
    for number, (name, changes) in enumerate(variants.items(), 1):
        how = options_of(options, folder, name, changes)
        found = trained(options.kind, how, f"{number} of {len(variants)}: {name}")
        errors = found["errors"]["the network"]
        nets[name] = checkpoint.load(how.out / f"{options.kind}.npz")
        rows.append({"name": name, "masked": errors["rmse_masked"], "steps": found["steps"],
                     "best": found["best_step"], "errors": errors})  # fmt: skip
    spent = evaluate.milliseconds(list(nets.values()), SIDE)
    rows = [row | {"ms": ms} for row, ms in zip(rows, spent, strict=True)]
    last = "volume_bias" if options.kind == "height" else "delta_e"
    table = [
        [r["name"], f"{r['ms']:.1f}", r["steps"], r["best"], f"{r['masked']:.4f}"]
        + [f"{r['errors']['rmse_whole']:.4f}", f"{r['errors'][last]:.3f}"]
        for r in rows
    ]
    columns = ["variant", "ms", "updates", "best", "masked", "whole", last.replace("_", " ")]
    chart(options.kind, rows, folder / "ablations.png")
    stored = data.load(make_dataset.build(options.preset, options.data))
    sheet(options.kind, nets, stored, folder / "sheet.png")
    write_run(folder, options, {"rows": rows})
    print_table(f"{options.kind}: variants, test pairs", columns, table)
    console.print(f"chart: {folder / 'ablations.png'}   pictures: {folder / 'sheet.png'}")


if __name__ == "__main__":
    main(tyro.cli(Config, description=helped(__doc__)))
