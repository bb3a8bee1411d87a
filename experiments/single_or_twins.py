"""One network for color and height, or two: the paper's Figure 6, as errors against time.

All are trained from nothing on the same pairs for the same number of updates. Twins are judged as
they are used: the color network is given the height that its twin predicts. The wide single network
takes about as long to paint as both twins. Networks that are trained are not trained again.

python -m experiments.single_or_twins                    # six networks, some minutes each
python -m experiments.single_or_twins --preset cpu --steps 2000
"""

import dataclasses
from pathlib import Path
from typing import Literal

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import tyro

from experiments import ablations, evaluate, evaluation, make_dataset, train_network
from experiments.common import (
    COLORS,
    helped,
    label_points,
    print_table,
    results_folder,
    save_figure,
    write_run,
)
from jaxbrush import batches, checkpoint, data

WIDE = 0.35
"""Width of a single network that takes as long as twins of a quarter: by the square."""
ALONE = {
    "height": ("height", {}),
    "color": ("color", {}),
    "color, painted": ("color", {"mixes": False}),
    "single": ("single", {}),
    "single, as long to paint": ("single", {"width": WIDE}),
    "single, painted": ("single", {"mixes": False}),
}
"""Networks that are trained: kind, and what changes of the default."""
TWINS = {"twins": ("height", "color"), "twins, painted": ("height", "color, painted")}
ROWS = 4
"""Test pairs on the sheet."""


@dataclasses.dataclass(frozen=True)
class Config:
    """One network for color and height beside two, trained alike. "painted" are networks that paint
    colors, as the paper's, in place of shares of the paints."""

    preset: Literal["tiny", "cpu", "small", "paper"] = "tiny"
    """Data set (see make_dataset)."""
    data: Path | None = None
    """Folder of the data set [default: results/data_<preset>]."""
    steps: int = 1500
    """Updates of each network."""
    out: Path | None = None
    """Folder [default: results/single_or_twins]."""
    quick: bool = False
    """20 updates: the same code."""


def pictures(folder: Path, found: data.Dataset, index) -> dict[str, dict]:
    """Of each way to paint: color and height (n, h, w, 3 and 1) in network scale, and the time [ms]
    of one pair."""
    nets = {
        name: checkpoint.load(ablations.place(folder, name) / f"{kind}.npz")
        for name, (kind, _) in ALONE.items()
    }
    side = found.options.pairs.size
    spent = dict(zip(nets, evaluate.milliseconds(list(nets.values()), side), strict=True))

    def pairs(kind, net):
        return train_network.pairs_of(
            found, "test", index, kind, train_network.Config(**net.card["inputs"])
        )

    out = {}
    for way, (height, color) in TWINS.items():
        laid = train_network.predicted_heights(found, "test", index, nets[height])
        laid = batches.network_height(laid)
        used = evaluate.with_height(pairs("color", nets[color]), laid)
        out[way] = {
            "height": evaluate.predicted(nets[height], pairs("height", nets[height])),
            "color": evaluate.predicted(nets[color], used),
            "ms": spent[height] + spent[color],
        }
    for way, (kind, _) in ALONE.items():
        if kind == "single":
            both = evaluate.predicted(nets[way], pairs(kind, nets[way]))
            out[way] = {"color": both[..., :3], "height": both[..., 3:], "ms": spent[way]}
    return out


def lit(height, color, pixel: float):
    """Pictures in light of heights and colors in network scale, (n, h, w, 3) uint8."""
    mm = batches.LEVELS["height"] * 0.5 * (jnp.asarray(height)[..., 0] + 1.0)
    return ablations.in_light(mm, 0.5 * (jnp.asarray(color) + 1.0), pixel)


def sheet(columns: dict[str, np.ndarray], path: Path):
    """A row a pair, a column a way to paint, each (n, h, w, 3)."""
    figure, axes = plt.subplots(1, len(columns), figsize=(2.2 * len(columns), 2.1 * ROWS))
    for axis, (name, pictures) in zip(axes, columns.items(), strict=True):
        axis.imshow(np.concatenate(list(pictures)))
        axis.set_title(name, fontsize=8)
        axis.axis("off")
    save_figure(figure, path)


def chart(rows: list[dict], path: Path):
    figure, axes = plt.subplots(1, 2, figsize=(9.6, 4.2))
    figure.suptitle("One network or two, trained alike; painted: colors, not shares of paints")
    measures = {
        "height": "height: RMSE in the mask, network scale",
        "delta_e": "color: ΔE (CIEDE2000)",
    }
    for axis, (measure, label) in zip(axes, measures.items(), strict=True):
        labels = []
        for row in rows:
            twins = row["name"] in TWINS
            axis.plot(row["ms"], row[measure], "o", color=COLORS[0 if twins else 1])
            labels.append((row["name"], (row["ms"], row[measure]), {"fontsize": 8}))
        axis.margins(x=0.25, y=0.2)
        axis.set_ylim(bottom=0.0)
        axis.set_xlabel("time to paint a pair [ms]")
        axis.set_ylabel(label)
        label_points(axis, labels)
    save_figure(figure, path)


def main(options: Config) -> None:
    folder = results_folder("single_or_twins", options.out)
    how = ablations.Config(
        preset=options.preset, data=options.data, steps=options.steps, quick=options.quick
    )
    for number, (name, (kind, changes)) in enumerate(ALONE.items(), 1):
        ablations.trained(kind, ablations.options_of(how, folder, name, changes),
                          f"{number} of {len(ALONE)}: {name}")  # fmt: skip
    found = data.load(make_dataset.build(options.preset, options.data))
    index = np.arange(found.count("test"))
    scale = evaluation.Scale(batches.LEVELS["height"], found.options.pairs.paint.pixel)
    truth = evaluation.parts(
        "single", np.zeros((1, 1, 1, 4)),
        train_network.pairs_of(found, "test", index, "single", train_network.Config()),
    )  # fmt: skip
    ways = pictures(folder, found, index)
    rows = []
    for name, way in ways.items():
        errors = {
            part: evaluation.errors(part, way[part], truth[part][1].batch, scale)
            for part in ("height", "color")
        }
        rows.append({"name": name, "ms": way["ms"], "errors": errors}
                    | {"height": errors["height"]["rmse_masked"]}
                    | {"color": errors["color"]["rmse_masked"]}
                    | {"delta_e": errors["color"]["delta_e"]})  # fmt: skip
    chart(rows, folder / "chart.png")
    some = np.linspace(0, len(index) - 1, min(ROWS, len(index))).astype(int)
    of = {part: truth[part][1] for part in ("height", "color")}
    columns = {
        "before": [of[part].background[some] for part in ("height", "color")],
        "simulator": [np.asarray(of[part].batch.target)[some] for part in ("height", "color")],
    } | {name: [way["height"][some], way["color"][some]] for name, way in ways.items()}
    sheet({name: lit(*pair, scale.pixel) for name, pair in columns.items()}, folder / "sheet.png")
    write_run(folder, options, {"rows": rows})
    names = ["way", "ms", "height, mask", "normal °", "color, mask", "ΔE", "ΔE p95", "off hull %"]
    table = [
        [r["name"], f"{r['ms']:.1f}", f"{r['height']:.4f}"]
        + [f"{r['errors']['height']['normal_angle']:.2f}", f"{r['color']:.4f}"]
        + [f"{r['errors']['color'][k]:.2f}" for k in ("delta_e", "delta_e_p95")]
        + [f"{100.0 * r['errors']['color']['out_of_hull']:.1f}"]
        for r in rows
    ]
    print_table(f"{len(index)} test pairs", names, table)
    print(f"chart: {folder / 'chart.png'}   pictures: {folder / 'sheet.png'}")


if __name__ == "__main__":
    main(tyro.cli(Config, description=helped(__doc__)))
