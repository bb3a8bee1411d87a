"""How accurate is the paint simulator, what does a stroke cost, and where does it break?

A flat brush crosses a wet band of another color. Every setting sees the same bristles and is
compared with the preset `reference`: thickness and color where the stroke changed the canvas. Beads
at the period of the stamps (the paper's Figure 1b) are looked for in the spectrum along the stroke.
A map shows where the simulator holds. The pressure of one stamp is also solved by scipy and, where
installed, pyamg.

    python -m experiments.paint_accuracy            # about 10 minutes, most of it compilation
    python -m experiments.paint_accuracy --quick    # about 2 minutes
"""

import dataclasses
import os
import time
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
import tyro
from matplotlib.ticker import LogLocator, NullFormatter
from rich.progress import Progress

from experiments import common
from experiments.common import COLORS, INK, console, helped, print_table
from experiments.paint_cases import (
    BRISTLES,
    DEEP,
    GRID,
    WIDTH,
    Setting,
    beads,
    canvas_of,
    errors,
    lay,
    paint,
    thinned,
    touched,
    track_of,
)
from experiments.paint_pressure import compare_solvers, system_of
from experiments.paint_stability import chart_stability, stability
from jaxbrush.paint import heightfield_config, load_brush, presets

FAMILIES = {
    "interval": ("stamp interval", "o"),
    "iterations": ("viscous + pressure rounds", "s"),
    "solver": ("solver of the pressure", "^"),
    "layers": ("height of the cells", "D"),
    "bristles": ("bristles", "v"),
    "pixel": ("pixel", "P"),
    "films": ("two films in place of a grid", "X"),
}
BARS = {"offline": ("stamp", 20.0), "realtime": ("mm", 5.0), "heightfield": ("stamp", 3.0)}
"""[ms] a stamp, or a millimetre of stroke."""
VISIBLE, TALL = 1.5, 20.0
"""Beads: a spectral line this many times its surroundings, and so tall [um]."""


@dataclasses.dataclass(frozen=True)
class Config:
    """Speed and accuracy of the paint simulator."""

    out: Path | None = None
    """Folder for charts and numbers [default: results/paint_accuracy]."""
    quick: bool = False
    """A shorter stroke and a few settings: the same code."""
    length: float = 9.0
    """Length of the stroke [mm]."""
    only: tuple[str, ...] = tuple(FAMILIES)
    """What to vary."""
    rounds: int = 3
    """Warm calls of each setting, in turn; the minimum is kept."""


def settings(options: Config) -> list[Setting]:
    """Presets first, then one change at a time of `offline` with stamps a pixel apart."""
    found = []
    for name in ("offline", "realtime"):
        bristles = BRISTLES if name == "offline" else BRISTLES // 2
        config, _, spacing = getattr(presets, name)(bristles)
        config = dataclasses.replace(config, pigments=2)
        found.append(Setting(name, "", name, config, spacing, bristles))
    base = found[0].config

    def vary(family, tag, spacing=GRID, bristles=BRISTLES, **changes):
        found.append(Setting(f"{family} {tag}", family, tag,
                             dataclasses.replace(base, **changes), spacing, bristles))  # fmt: skip

    found.append(
        Setting("heightfield", "films", "heightfield", heightfield_config(pigments=2), GRID)
    )
    weak = {"viscous": 1, "pressure": 2}
    vary("interval", "1 px")
    vary("interval", "4 px", 4 * GRID)
    vary("interval", "4 px, 1 + 2 rounds", 4 * GRID, **weak)
    if options.quick:
        return found
    vary("interval", "2 px", 2 * GRID)
    vary("interval", "2 px, 1 + 2 rounds", 2 * GRID, **weak)
    vary("interval", "1 px, 1 + 2 rounds", **weak)
    vary("interval", "4 px, 4 points a way", 4 * GRID, sweeps=4)
    vary("iterations", "3 + 5", viscous=3, pressure=5)
    vary("iterations", "6 + 10", viscous=6, pressure=10, spectrum=0.9)
    vary("iterations", "18 + 40", viscous=18, pressure=40)
    vary("solver", "line PCG 8", solver="zline_pcg", pressure=8)
    vary("solver", "line PCG 5", solver="zline_pcg", pressure=5)
    vary("solver", "Jacobi PCG 20", solver="jacobi_pcg")
    vary("solver", "fixed point 20", solver="fixed_point")
    vary("layers", "1/8 mm", layer=0.125, layers=8)
    vary("layers", "1/8 mm, 1/2 px", GRID / 2, layer=0.125, layers=8)
    vary("pixel", "1/4 mm", 2 * GRID, pixel=0.25, window=32)
    vary("bristles", "65", bristles=65)
    return [s for s in found if not s.family or s.family in options.only]


def reference(options: Config) -> Setting:
    config, _, spacing = presets.reference()
    config = dataclasses.replace(config, pigments=2)
    if options.quick:
        config, spacing = dataclasses.replace(config, layer=0.0625, layers=16), GRID / 2
    return Setting("reference", "", "reference", config, spacing)


def clock(calls: dict, rounds: int, progress: Progress) -> dict:
    """Least time of warm calls, in turn [s]: on one core the time this process held it."""
    low = dict.fromkeys(calls, np.inf)
    for _ in progress.track(range(rounds), description="timing"):
        for name, call in calls.items():
            start = now()
            jax.block_until_ready(call())
            low[name] = min(low[name], now() - start)
    return low


def cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def now() -> float:
    return time.process_time() if cores() == 1 else time.perf_counter()


def machine() -> str:
    kind = "CPU time on 1 core" if cores() == 1 else f"{cores()} cores"
    return f"{kind}, load {os.getloadavg()[0]:.1f}"


def pressures(base: Setting, options: Config) -> dict:
    """The pressure's solvers in the middle of the stroke, and of one over a wet canvas."""
    track = thinned(track_of(options.length), base.spacing)
    at = track.time.shape[0] * 6 // 10
    brush = load_brush(base.config, presets.params_of(), BRISTLES, 0.8, jax.numpy.eye(2)[0])
    before = dataclasses.replace(track, valid=track.valid & (np.arange(len(track.time)) < at))
    found = {}
    for name, band in (("a band", None), ("a wet canvas", (0.0, WIDTH))):
        canvas = canvas_of(base.config) if band is None else canvas_of(base.config, band)
        canvas, *_ = paint(base.config, presets.params_of(), canvas, brush, before)
        matrix, rhs = system_of(base, canvas, track, at)
        found[name] = compare_solvers(matrix, rhs, options.rounds, now)
    return found


def chart(points: list[dict], results: dict, options: Config, path: Path):
    """Time against both errors; beads by interval; the surface of four settings."""
    figure = plt.figure(figsize=(15.0, 9.0))
    grid = figure.add_gridspec(2, 12, height_ratios=(1.6, 1.0))
    panels = [figure.add_subplot(grid[0, 4 * k : 4 * k + 4]) for k in range(3)]
    labels = ("height, rms [µm]", "color, mean ΔE (CIEDE2000)")
    names = {axis: [] for axis in panels[:2]}

    def note(axis, text, at, offset=(6, 4), **style):
        axis.annotate(text, at, offset, textcoords="offset points", **style).set_in_layout(False)

    for k, (axis, label) in enumerate(zip(panels[:2], labels, strict=True)):
        for (family, (text, marker)), color in zip(FAMILIES.items(), (*COLORS, INK), strict=True):
            mine = [p for p in points if p["family"] == family]
            x, y = [p["error"][k] for p in mine], [p["ms_per_mm"] for p in mine]
            axis.plot(x, y, marker, color=color, label=text, zorder=3)
            # The solvers lie on top of each other; the table has them.
            if family != "solver":
                style = {"fontsize": 7, "color": color}
                names[axis] += [(p["tag"], at, style) for p, *at in zip(mine, x, y, strict=True)]
        for p in points[:2]:
            at = p["error"][k], p["ms_per_mm"]
            axis.plot(*at, "o", ms=13, mew=1.6, mfc="none", mec=INK, zorder=5)
            names[axis].insert(0, ("  " + p["name"], at, {"weight": "bold"}))
        axis.axhline(BARS["realtime"][1], color=INK, lw=0.8, ls=(0, (4, 3)))
        low, high = (f(p["error"][k] for p in points) for f in (min, max))
        axis.set(xscale="log", yscale="log", xlabel=label, xlim=(0.65 * low, 2.2 * high))
        axis.margins(y=0.12)
        axis.xaxis.set(major_locator=LogLocator(subs=(1, 2, 5)), major_formatter="{x:g}",
                       minor_formatter=NullFormatter())  # fmt: skip
    panels[0].set(ylabel="time for a millimetre of stroke [ms]", title="Speed against accuracy")
    panels[0].legend(fontsize=8, loc="lower left", bbox_to_anchor=(0.0, 0.08))
    axis = panels[2]
    kinds = {"": "9 + 20 rounds", ", 1 + 2 rounds": "1 + 2 rounds"}
    for (rounds, label), color in zip(kinds.items(), COLORS[1::-1], strict=True):
        mine = [p for p in points if p["name"] in [f"interval {n} px{rounds}" for n in (2, 4)]]
        mine.sort(key=lambda p: p["spacing"])
        seen = [p["beads"] for p in mine]
        axis.plot([p["spacing"] for p in mine], [s[0] for s in seen], "o-", color=color,
                  label=label)  # fmt: skip
        for p in mine:
            note(axis, f"{p['beads'][1]:.0f} µm", (p["spacing"], p["beads"][0]), (-4, 8),
                 ha="right", color=color)  # fmt: skip
    real = points[1]["spacing"], points[1]["beads"][0]
    axis.plot(*real, "o", ms=13, mew=1.6, mfc="none", mec=INK)
    note(axis, "realtime", real, (12, -4), weight="bold")
    axis.axhline(VISIBLE, color=INK, lw=0.8, ls=(0, (4, 3)))
    axis.set(xlabel="between stamps [mm]", ylabel="spectrum at that period over its surroundings",
             title="Beads, and how tall", ylim=(0.0, None), xlim=(0.2, 0.55))  # fmt: skip
    axis.legend(fontsize=8)
    shown = ("reference", "offline", "realtime", "interval 4 px, 1 + 2 rounds")
    for k, name in enumerate(n for n in shown if n in results):
        axis = figure.add_subplot(grid[1, 3 * k : 3 * k + 3])
        height = results[name].height
        slope = np.gradient(height, GRID, axis=1) + np.gradient(height, GRID, axis=0)
        axis.imshow(np.clip(0.55 - 0.35 * slope, 0.0, 1.0), cmap="gray", vmin=0.0, vmax=1.0,
                    extent=(0.0, WIDTH, height.shape[0] * GRID, 0.0))  # fmt: skip
        axis.set(xlim=(2.0, 15.0), title=name.removeprefix("interval "), xticks=[], yticks=[])
        axis.grid(False)
    figure.suptitle("What a stroke of paint costs, and how far it is from the reference", x=0.01,
                    ha="left")  # fmt: skip
    figure.supxlabel(
        f"Flat brush of 4.5 mm, {BRISTLES} bristles, {options.length:g} mm of stroke over a wet "
        f"band {DEEP:g} mm thick; errors where the reference changed the canvas, on pixels of "
        f"{GRID:g} mm. Circles: presets;\nthe others change one thing of the setting `1 px`. "
        "Dashed: the bar of `realtime`, and where beads begin. Below: the relief. "
        f"{machine()}.",
        fontsize=9, x=0.01, ha="left",
    )  # fmt: skip
    for axis, found in names.items():
        common.label_points(axis, found)
    common.save_figure(figure, path)


def report(points: list[dict], solved: dict, options: Config) -> None:
    rows = []
    for p in points:
        left = p["residual"]
        rows.append(
            [p["name"], f"{p['ms_per_stamp']:.1f}", f"{p['ms_per_mm']:.1f}",
             f"{p['error'][0]:.0f}", f"{p['error'][1]:.2f}", f"{p['laid']:.2f}",
             "" if p["beads"] is None else f"{p['beads'][0]:.1f} ({p['beads'][1]:.0f})",
             f"{100 * left[0]:.0f} / {100 * left[1]:.1f}", f"{p['drift']:.0e}"]
        )  # fmt: skip
    print_table(
        f"{options.length:g} mm of stroke; {machine()}",
        ["setting", "ms/stamp", "ms/mm", "height [µm]", "ΔE", "laid [mm³]", "beads (µm)",
         "left [%]", "drift"], rows, 0,
    )  # fmt: skip
    for name, found in solved.items():
        rows = [[r["solver"], f"{1e3 * r['seconds']:.2f}", f"{100 * r['residual']:.2g}",
                 f"{100 * r['error']:.2g}"] for r in found]  # fmt: skip
        print_table(f"The pressure of a stamp over {name}, the same matrix for all",
                    ["solver", "ms", "residual [%]", "error [%]"], rows)  # fmt: skip
        if not any("pyamg" in r["solver"] for r in found):
            console.print("pyamg is not installed and was left out: pip install pyamg")


def main(options: Config) -> None:
    if options.quick:
        options = dataclasses.replace(options, length=7.0, rounds=2)
    folder = common.results_folder("paint_accuracy", options.out)
    every = settings(options)
    results, calls = {}, {}
    with Progress(console=console, transient=True) as progress:
        for s in progress.track([reference(options), *every], description="settings"):
            results[s.name], call = lay(s, options.length)
            if s.name != "reference":
                calls[s.name] = call
        took = clock(calls, options.rounds, progress)
        solved = pressures(every[0], options)
        true, points = results["reference"], []
        seen = VISIBLE, TALL
        held = stability(every[0].config, true, options.length, options.quick, seen, progress)
    for s in every:
        r, seconds = results[s.name], took[s.name]
        # A period of two pixels is the shortest that they show.
        seen = beads(r, s.spacing) if s.spacing >= 2 * max(GRID, s.config.pixel / 2) else None
        points.append(
            {"name": s.name, "family": s.family, "tag": s.tag, "error": errors(r, true),
             "seconds": seconds, "ms_per_stamp": 1e3 * seconds / r.stamps,
             "ms_per_mm": 1e3 * seconds / options.length, "laid": r.laid, "beads": seen,
             "residual": r.residual, "drift": r.drift, "fullest": r.fullest,
             "spacing": s.spacing, "bristles": s.bristles, "config": s.config}
        )  # fmt: skip
    chart(points, results, options, folder / "accuracy.png")
    chart_stability(held, true, folder / "stability.png")
    film = float(true.height[touched(true)].mean())
    common.write_run(folder, options, {
        "points": points, "stability": held, "reference": {"laid": true.laid, "mean_film_mm": film,
        "residual": true.residual, "stamps": true.stamps}, "pressure": solved,
        "measured_on": machine(),
    })  # fmt: skip
    report(points, solved, options)
    console.print(f"reference: laid {true.laid:.2f} mm³, mean film {1e3 * film:.0f} µm.")
    for name, (unit, bar) in BARS.items():
        have = next((p for p in points if p["name"] == name), None)
        if have is None:
            continue
        have = have[f"ms_per_{unit}"]
        verdict = "passed" if have <= bar else "NOT passed"
        console.print(f"Bar, {name} within {bar:g} ms a {unit}: {have:.1f} ms, {verdict}.")
    for p in points:
        if p["beads"] and p["beads"][0] > VISIBLE and p["beads"][1] > TALL:
            console.print(f"Beads: {p['name']}, {p['beads'][1]:.0f} µm tall, "
                          f"{p['beads'][0]:.1f} x their surroundings.")  # fmt: skip


if __name__ == "__main__":
    main(tyro.cli(Config, description=helped(__doc__)))
