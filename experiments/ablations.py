"""What each part of the networks is worth: the default and its variants, trained alike.

Every variant is trained from nothing on the same pairs for the same number of updates (or minutes),
and charted by its error on test pairs against the time it takes to paint one. The default comes
again with another seed: differences smaller than that are noise. Variants that are done are not
trained again.

python -m experiments.ablations                        # height, about 5 minutes a variant
python -m experiments.ablations --kind color --steps 4000
python -m experiments.ablations --only default "width 1/2" "width 1/8" --minutes 10
"""

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Literal

import matplotlib.pyplot as plt
import tyro
from matplotlib.ticker import LogLocator, NullFormatter

from experiments import evaluate, train_network
from experiments.common import (
    COLORS,
    INK,
    console,
    print_table,
    results_folder,
    save_figure,
    write_run,
)
from jaxbrush import checkpoint

SIDE = 128
"""Of the picture whose time is taken [pixels]."""
_BOTH = {
    "another seed": {"seed": 1},
    "width 1/8": {"width": 0.125},
    "width 1/2": {"width": 0.5},
    "no discriminator": {"gan": 0.0},
    "the paper's 10 L1 : 1 cGAN": {"gan": 1.0},
    "no instance normalisation": {"norm": "none"},
    "no time map": {"time": False},
}
VARIANTS = {
    "height": _BOTH | {
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
        "no new height": {"height": False}, "no recoloring": {"recolor": False},
        "a color, not shares": {"mixes": False},
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


def options_of(options: Config, folder: Path, name: str, changes: dict) -> train_network.Config:
    """How a variant is trained."""
    steps = None if options.minutes is not None else options.steps
    return train_network.Config(
        **changes, preset=options.preset, data=options.data, out=folder / name.replace("/", "_"),
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


def chart(kind: str, rows: list[dict], path: Path):
    figure, axis = plt.subplots(figsize=(8.4, 5.0))
    noise = [r["masked"] for r in rows if r["name"] in ("default", "another seed")]
    if len(noise) == 2:
        axis.axhspan(min(noise), max(noise), color=COLORS[0], alpha=0.15, lw=0)
    for row in rows:
        own = row["name"] == "default"
        axis.plot(row["ms"], row["masked"], "o", ms=8 if own else 5, color=COLORS[0 if own else 1])
        axis.annotate(row["name"], (row["ms"], row["masked"]), xytext=(6, 0), color=INK,
                      textcoords="offset points", va="center", fontsize=8)  # fmt: skip
    axis.set_xscale("log")
    axis.margins(x=0.3)
    axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.xaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.set_xlabel(f"time to paint {SIDE} x {SIDE} pixels [ms]")
    axis.set_ylabel("RMSE in the mask, network scale")
    axis.set_title(f"{kind}: what each part is worth; the band is another seed")
    save_figure(figure, path)


def main(options: Config) -> None:
    variants = chosen(options)
    folder = results_folder(f"ablations_{options.kind}", options.out)
    rows = []
    for number, (name, changes) in enumerate(variants.items(), 1):
        how = options_of(options, folder, name, changes)
        found = _done(how)
        if found is None:
            console.print(f"{number} of {len(variants)}: {name}")
            if how.out.exists() and (how.out / "metrics.json").exists():
                raise SystemExit(f"{how.out}: was trained in another way; use another --out")
            resumed = dataclasses.replace(how, resume=(how.out / "checkpoints").exists())
            found = train_network.main(options.kind, resumed)
            write_run(how.out, how, found)
        errors = found["errors"]["the network"]
        ms = evaluate.milliseconds(checkpoint.load(how.out / f"{options.kind}.npz"), SIDE)
        rows.append({"name": name, "ms": ms, "masked": errors["rmse_masked"], "steps":
                     found["steps"], "best": found["best_step"], "errors": errors})  # fmt: skip
    last = "volume_bias" if options.kind == "height" else "delta_e"
    table = [
        [r["name"], f"{r['ms']:.1f}", r["steps"], r["best"], f"{r['masked']:.4f}"]
        + [f"{r['errors']['rmse_whole']:.4f}", f"{r['errors'][last]:.3f}"]
        for r in rows
    ]
    columns = ["variant", "ms", "updates", "best", "masked", "whole", last.replace("_", " ")]
    chart(options.kind, rows, folder / "ablations.png")
    write_run(folder, options, {"rows": rows})
    print_table(f"{options.kind}: variants, test pairs", columns, table)
    console.print(f"chart: {folder / 'ablations.png'}")


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
