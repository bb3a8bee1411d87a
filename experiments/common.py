"""What the experiments share: where results go, how time is taken, how charts and tables look."""

import dataclasses
import itertools
import json
import os
import re
import sys
import time
from pathlib import Path

import jax
import matplotlib
import matplotlib.transforms
import numpy as np
from rich.console import Console
from rich.table import Table

from jaxbrush.platform import keep_memory

matplotlib.use("Agg")
keep_memory()

# Tables need the width where nobody watches, too.
console = Console(width=None if sys.stdout.isatty() else 120)

INK, FAINT = "#26221e", "#8d857b"
COLORS = ("#b5482a", "#1f6f78", "#d59a2b", "#5b4a8a", "#6c8a3c", "#8a8178")

matplotlib.rcParams.update(
    {
        "figure.facecolor": "white",
        "figure.constrained_layout.use": True,
        "savefig.dpi": 130,
        "font.size": 10,
        "axes.edgecolor": FAINT,
        "axes.labelcolor": INK,
        "axes.titlelocation": "left",
        "axes.titlesize": 11,
        "axes.titleweight": "bold",
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "grid.color": "#e4dfd8",
        "grid.linewidth": 0.6,
        "axes.prop_cycle": matplotlib.cycler(color=COLORS),
        "legend.frameon": False,
        "text.color": INK,
        "xtick.color": FAINT,
        "ytick.color": FAINT,
        "xtick.labelcolor": INK,
        "ytick.labelcolor": INK,
    }
)


def helped(text: str) -> str:
    """A module's docstring as `--help` shows it, which joins lines: every command on its own."""
    return re.sub(r"\n+python -m", "\n\npython -m", text)


def results_folder(name: str, out: Path | None) -> Path:
    """The folder of a run, made if need be: `out`, or results/<name>."""
    folder = Path("results") / name if out is None else Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _plain(value):
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if isinstance(value, (np.ndarray, jax.Array)):
        return np.asarray(value).tolist()
    if isinstance(value, np.generic):
        return value.item()
    return str(value)


def write_json(path: Path, value):
    """Writes `value` as JSON under a temporary name and renames it, so a reader never sees half."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps(value, indent=1, default=_plain) + "\n")
    os.replace(partial, path)


def write_run(folder: Path, config, metrics: dict):
    """Writes config.json and metrics.json of a run, with the versions and the device."""
    machine = {
        "jax": jax.__version__,
        "device": str(jax.devices()[0]),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None,
    }
    write_json(folder / "config.json", config)
    write_json(folder / "metrics.json", {"machine": machine, **metrics})


def save_figure(figure, path: Path, **options):
    """Saves and closes a figure, under a temporary name first."""
    partial = path.with_name(path.name + ".partial")
    figure.savefig(partial, format=path.suffix[1:], **options)
    matplotlib.pyplot.close(figure)
    os.replace(partial, path)


def label_points(axis, labels):
    """Writes names beside points, each where it covers no other and no point, inside the axes.

    Call it when limits are set and all else is drawn.

    Args:
      labels: (text, (x, y), dict of text properties) each; the first choose first.
    """
    figure = axis.figure
    figure.draw_without_rendering()  # the layout, which sizes the axes
    renderer, frame = figure.canvas.get_renderer(), axis.get_window_extent()
    places = axis.transData.transform([at for _, at, _ in labels])
    taken = [matplotlib.transforms.Bbox.from_bounds(x - 4, y - 4, 8, 8) for x, y in places]
    sides = ((1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (-1, 0))
    for text, at, style in labels:
        best = np.inf, None, None
        for away, (side, up) in itertools.product((5, 12, 20, 28), sides):
            offset = (side * (5 if up else away), up * away)
            note = axis.annotate(
                text, at, offset, textcoords="offset points", va="center",
                ha="left" if side > 0 else "right", **style,
            )  # fmt: skip
            note.set_in_layout(False)
            box = note.get_window_extent(renderer)
            outside = not (frame.contains(box.x0, box.y0) and frame.contains(box.x1, box.y1))
            cost = 10 * outside + sum(box.overlaps(b) for b in taken)
            worse, best = (note, best) if cost >= best[0] else (best[1], (cost, note, box))
            if worse is not None:
                worse.remove()
            if best[0] == 0:
                break
        taken.append(best[2])


def print_table(title: str, columns: list[str], rows: list[list], marked: int | None = None):
    """Prints a table, the first column left and the others right; row `marked` in bold."""
    table = Table(title=title, title_justify="left", title_style="bold", header_style="dim")
    for index, name in enumerate(columns):
        table.add_column(name, justify="left" if index == 0 else "right", no_wrap=index > 0)
    for index, row in enumerate(rows):
        table.add_row(*map(str, row), style="bold" if index == marked else None)
    console.print(table)


@dataclasses.dataclass(frozen=True)
class Timing:
    """first: the first call, compilation included; low and median: of the warm calls [s]."""

    first: float
    low: float
    median: float

    def __str__(self):
        return f"{self.low * 1e3:.3g} / {self.median * 1e3:.3g}"


def timed(function, *args, repeats: int = 7, budget: float = 5.0):
    """Calls `function(*args)` once cold and up to `repeats` times warm, waiting for the result.

    Args:
      repeats: warm calls. budget: no further warm call once they took this long together [s].

    Returns:
      (result of the first call, Timing).
    """
    start = time.perf_counter()
    result = jax.block_until_ready(function(*args))
    first = time.perf_counter() - start
    warm = []
    while not warm or (len(warm) < repeats and sum(warm) < budget):
        start = time.perf_counter()
        jax.block_until_ready(function(*args))
        warm.append(time.perf_counter() - start)
    return result, Timing(first=first, low=min(warm), median=float(np.median(warm)))
