"""Three engines paint the same session: pictures side by side, time and error (paper Figure 1 and
Table 1), and white painted over white (Figure 14).

python -m experiments.compare_engines
python -m experiments.compare_engines --quick            # eight strokes
"""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import tyro
from rich.progress import Progress

from experiments import engines, paint_session
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
from jaxbrush import metrics, painter
from jaxbrush.canvas import Canvas
from jaxbrush.paint import presets
from jaxbrush.recordings import BrushEvent

MARKS = (1, 2, 4, 8, 16, 32, 64, 128)
"""Strokes after which the canvases are compared."""
WHITES = 32
"""Strokes of white over white."""
WHITE = (0.92, 0.90, 0.84)
_delta_e = jax.jit(metrics.delta_e)
TOUCHED = 0.005
"""Film from which a pixel counts as painted [mm]."""


@dataclasses.dataclass(frozen=True)
class Config:
    """The same strokes by simulator and networks."""

    recording: Path | None = None
    """A session as paint_session reads it [default: the sea that comes along]."""
    strokes: int | None = None
    """So many strokes: the first ones, or more than there are, painted again over themselves."""
    weights: tuple[Path, Path] = engines.SHIPPED
    """Height and color network."""
    fast: tuple[Path, Path] | None = engines.FAST
    """A second pair of networks, of half the width."""
    whites: int = WHITES
    """Strokes of white over white."""
    out: Path | None = None
    """Folder for pictures and numbers [default: results/compare_engines]."""
    quick: bool = False
    """Eight strokes, eight of them white over white; no sweep of the real-time simulator."""


def makers(options: Config, shape, deeds) -> dict:
    """Engines by name, each made when it is called; the first is the truth."""
    palette = engines.palette_of(deeds)
    found = {
        name: lambda name=name: engines.make(name, shape, deeds, options.weights)
        for name in ("offline", "realtime", "neural")
    }
    if options.fast:
        nets = painter.load_nets(*options.fast)
        found["neural, fast"] = lambda: engines.Neural(painter.PainterConfig(), nets, shape)
    if not options.quick:
        (config, _, spacing), many = presets.realtime(), presets.REAL // 2
        for label, change, apart, bristles in (
            ("stamps 2 x apart", {}, 2.0 * spacing, many),
            ("stamps 2 x closer", {}, 0.5 * spacing, many),
            ("fewer rounds", {"viscous": 1, "pressure": 2}, spacing, many),
            ("half the bristles", {}, spacing, many // 2),
        ):
            setting = dataclasses.replace(config, **change)
            found[f"realtime, {label}"] = lambda s=setting, a=apart, b=bristles: engines.Simulator(
                s, a, shape, palette, b
            )
    return found


def play(engine, deeds, marks, step) -> tuple[dict[int, Canvas], list[dict]]:
    """Paints all deeds. Returns (canvases by number of strokes, seconds of each stage a stroke)."""
    canvases, spent = {}, []
    for number, deed in enumerate(deeds, 1):
        spent.append(engine.paint(deed))
        if number in marks or number == len(deeds):
            canvases[number] = engine.canvas()
        step()
    return canvases, spent


def errors(found: Canvas, true: Canvas) -> dict:
    """Where either is painted: height [µm], color [ΔE CIEDE2000]."""
    there = (np.asarray(true.height) > TOUCHED) | (np.asarray(found.height) > TOUCHED)
    apart = np.asarray(found.height - true.height)[there]
    color = np.asarray(_delta_e(found.color, true.color))[there]
    return {"height": 1e3 * float(np.sqrt(np.mean(apart**2))), "color": float(np.mean(color))}


def warm(spent: list[dict]) -> np.ndarray:
    """Milliseconds a stroke, without those that were compiled for: ten times slower than others."""
    took = 1e3 * np.asarray([sum(s.values()) for s in spent])
    return took[took < 10.0 * np.median(took)]


def whites_of(count: int, shape) -> list[engines.Deed]:
    """White strokes to and fro over the same place."""
    from experiments.paint_scenes import drawn

    brush, paint, say = engines.brush_of(BrushEvent({"load": 0.9}))
    middle = 0.5 * engines.PIXEL * np.asarray(shape[::-1], float)
    random = np.random.default_rng(3)
    deeds = []
    for number in range(count):
        half = np.asarray([0.3 * engines.PIXEL * shape[1], 0.0])
        half = half if number % 2 else -half
        shift = random.uniform(-1.5, 1.5, 2)
        path = np.stack([middle - half + shift, middle + shift, middle + half + shift])
        stroke = drawn(path, 0.4)
        deeds.append(engines.Deed(stroke, brush, paint, WHITE, say["load"], say["bristles"]))
    return deeds


def tint(canvas: Canvas) -> float:
    """Mean ΔE from the white itself, where white lies thick."""
    thick = np.asarray(canvas.height) > 0.15
    white = jnp.broadcast_to(jnp.asarray(WHITE), canvas.color.shape)
    return float(np.mean(np.asarray(_delta_e(canvas.color, white))[thick]))


def chart(options, canvases, results, tints, path: Path):
    """Pictures above; below time against both errors, error by stroke, white on white."""
    shown = [n for n in ("offline", "realtime", "neural", "neural, fast") if n in canvases]
    figure = plt.figure(figsize=(15.0, 9.5))
    grid = figure.add_gridspec(2, 12, height_ratios=(1.0, 1.0))
    each = 12 // len(shown)
    for k, name in enumerate(shown):
        axis = figure.add_subplot(grid[0, each * k : each * (k + 1)])
        axis.imshow(paint_session.lit(canvases[name]))
        axis.set(xticks=[], yticks=[])
        took = results[name]["milliseconds"]
        axis.set_title(f"{name}: {took:.0f} ms a stroke", loc="left")
        axis.grid(False)
    named = []
    for k, (measure, label) in enumerate(
        (("color", "color, mean ΔE (CIEDE2000)"), ("height", "height, rms [µm]"))
    ):
        axis, names = figure.add_subplot(grid[1, 3 * k : 3 * k + 3]), []
        for number, (name, row) in enumerate(results.items()):
            if name == "offline":
                axis.axhline(row["milliseconds"], color=INK, lw=0.8, ls=(0, (4, 3)))
                continue
            at = row["errors"][max(row["errors"])][measure], row["milliseconds"]
            axis.plot(*at, "o", color=COLORS[number % len(COLORS)])
            names.append((name.replace("realtime, ", ""), at, {"fontsize": 7}))
        axis.set(yscale="log", xlabel=label, title="Time against error" if not k else "")
        axis.margins(0.25, 0.2)
        named.append((axis, names))
        if not k:
            axis.set_ylabel("time a stroke [ms]; dashed: offline")
    axis = figure.add_subplot(grid[1, 6:9])
    for number, (name, row) in enumerate(results.items()):
        if name != "offline" and name in shown:
            x = sorted(row["errors"])
            axis.plot(x, [row["errors"][n]["color"] for n in x], "o-", label=name,
                      color=COLORS[number % len(COLORS)])  # fmt: skip
    axis.set(xscale="log", xlabel="strokes", ylabel="mean ΔE", title="Error as strokes add up")
    axis.legend(fontsize=8)
    axis = figure.add_subplot(grid[1, 9:12])
    for number, (name, curve) in enumerate(tints.items()):
        axis.plot(range(1, len(curve) + 1), curve, label=name, color=COLORS[number % len(COLORS)])
    axis.set(xlabel="white strokes over each other", ylabel="mean ΔE from white, where thick",
             title="White over white")  # fmt: skip
    axis.legend(fontsize=8)
    figure.suptitle("The same strokes by simulator and networks", x=0.01, ha="left")
    for axis, names in named:
        label_points(axis, names)
    save_figure(figure, path)


def main(options: Config) -> None:
    if options.quick:
        options = dataclasses.replace(options, strokes=8, whites=8)
    try:
        session = paint_session.read(options.recording)
        side = np.asarray(session.canvas)[::-1] / engines.PIXEL
        shape = tuple(int(n) for n in np.ceil(side))
        deeds = engines.deeds_of(session, shape)
        if deeds and options.strokes is not None:
            deeds = [deeds[n % len(deeds)] for n in range(options.strokes)]
        deeds = engines.mixable(deeds)
        made = makers(options, shape, deeds)
    except (ValueError, OSError) as error:
        raise SystemExit(f"{error}") from error
    folder = results_folder("compare_engines", options.out)
    results, last, truth, tints = {}, {}, {}, {}
    small = (128, 192)
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("", total=len(made) * len(deeds))
        for name, maker in made.items():
            progress.update(task, description=name)
            canvases, spent = play(maker(), deeds, MARKS, lambda: progress.advance(task))
            truth = truth or canvases
            took = warm(spent)
            results[name] = {
                "milliseconds": float(np.median(took)),
                "p95": float(np.percentile(took, 95)),
                "stages": {r[0]: r[1:] for r in paint_session.stages_of(spent)},
                "errors": {n: errors(c, truth[n]) for n, c in canvases.items()},
            }
            last[name] = canvases[len(deeds)]
            paint_session.save(folder / f"{name.replace(', ', '_').replace(' ', '_')}.png",
                               paint_session.lit(last[name]))  # fmt: skip
        session_deeds, deeds = deeds, whites_of(options.whites, small)
        names = [n for n in made if n in ("offline", "realtime") or n.startswith("neural")]
        task = progress.add_task("white over white", total=len(names) * len(deeds))
        for name in names:
            engine = makers(options, small, deeds)[name]()
            canvases, _ = play(engine, deeds, range(len(deeds) + 1), lambda: progress.advance(task))
            tints[name] = [tint(c) for c in canvases.values()]
            paint_session.save(folder / f"white_{name.split(', ')[-1]}.png",
                               paint_session.lit(canvases[len(deeds)]))  # fmt: skip
    chart(options, last, results, tints, folder / "engines.png")
    waits = engines.preview_times(
        painter.PainterConfig(), painter.load_nets(*options.weights), shape, session_deeds
    )
    named = ("median", "p95", "p99", "worst")
    quantiles, finished = (
        dict(zip(named, np.percentile(1e3 * w, (50, 95, 99, 100)), strict=True)) for w in waits
    )
    write_run(
        folder, options,
        {"engines": results, "white_over_white": tints, "preview_ms": quantiles,
         "finished_ms": finished},
    )  # fmt: skip
    rows = []
    for name, row in results.items():
        error = row["errors"][max(row["errors"])]
        rows.append(
            [name, f"{row['milliseconds']:.0f}", f"{row['p95']:.0f}", f"{error['height']:.0f}",
             f"{error['color']:.2f}", f"{tints[name][-1]:.2f}" if name in tints else ""]
        )  # fmt: skip
    print_table(
        f"{max(truth)} strokes on {shape[0]} x {shape[1]} pixels; errors against offline",
        ["engine", "ms/stroke", "p95", "height [µm]", "ΔE", f"ΔE, {options.whites} whites"],
        rows,
    )
    for name in names:
        rows = [[stage, *row] for stage, row in results[name]["stages"].items()]
        print_table(f"{name}: ms a stroke", ["stage", "median", "95 %", "worst", "first"], rows)

    print_table(
        "A session at the speed of a hand, the networks at work between strokes: ms",
        ["after", *named],
        [
            [what, *(f"{x:.1f}" for x in times.values())]
            for what, times in (("its last sample", quantiles), ("pen-up, the paint", finished))
        ],
    )  # fmt: skip


if __name__ == "__main__":
    main(tyro.cli(Config, description=helped(__doc__)))
