"""How accurate is each way to move the bristles, what does it cost, and where does it break?

Every integrator runs the same strokes in float32 and is compared with velocity Verlet in double
precision at steps of a few microseconds. The charts show time per stroke against the error of the
tips and of the force, and the steps and stiffnesses at which each method is stable. The last table
holds the fastest setting below each error, a peer in numba, and the floor of the machine.

    python -m experiments.brush_accuracy            # about 15 minutes on one core
    python -m experiments.brush_accuracy --quick    # about 2 minutes
"""

import dataclasses
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import tyro
from rich.progress import Progress

from experiments import brush_costs, brush_stability
from experiments.brush_cases import (
    DURATION,
    KINDS,
    STAMP,
    Errors,
    brush_of,
    compare,
    errors,
    pooled,
    reference_of,
    roll,
    single,
    stable_substeps,
    stroke_of,
)
from experiments.common import (
    COLORS,
    INK,
    Timing,
    console,
    helped,
    print_table,
    results_folder,
    save_figure,
    timed,
    write_run,
)
from jaxbrush.brush import BrushConfig
from jaxbrush.brush.shapes import AXIAL_SOFTENING

FEEL, TIP_BAR, FORCE_BAR = 10.0, 1.0, 5.0
"""Bars on the chart: [ms] per stroke, [%] of the tip, [%] of the force."""
NAMES = {
    "quasi_static": "quasi-static",
    "projective": "projective (implicit Euler)",
    "implicit_euler": "implicit Euler, Newton",
    "verlet": "velocity Verlet",
    "symplectic_euler": "symplectic Euler",
}


@dataclasses.dataclass(frozen=True)
class Config:
    """Speed, accuracy and stability of the bristle integrators."""

    out: Annotated[Path | None, tyro.conf.arg(help="Folder for charts and numbers.")] = None
    """Folder for charts and numbers [default: results/brush_accuracy]."""
    quick: bool = False
    """A small brush, two strokes and a coarse grid of settings: the same code in a few minutes."""
    bristles: int = 256
    """Bristles of the brush that is timed; a multiple of 16."""
    shapes: tuple[str, ...] = ("flat", "round")
    """Brush shapes of the comparison."""
    strokes: tuple[str, ...] = KINDS
    """Strokes of the comparison."""
    fineness: float = 2.0
    """Reference steps, as a multiple of the fewest stable ones."""
    repeats: int = 9
    """Warm runs of each setting; the minimum and the median are kept."""
    stability: bool = True
    """Whether to draw the stability map."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """One point of the chart: a rollout config and its stamp interval [s]."""

    config: BrushConfig
    interval: float = STAMP

    def __str__(self):
        c = self.config
        text = f"{NAMES[c.integrator]}, {self.interval * 1e3:g} ms"
        if c.solve_stride > 1:
            text += (
                f", every {c.solve_stride}nd"
                if c.solve_stride == 2
                else f", every {c.solve_stride}th"
            )
        if c.substeps > 1:
            text += f" / {c.substeps}"
        if c.integrator not in ("verlet", "symplectic_euler"):
            text += f", {c.iterations} it."
        text += f", {c.contact_nodes} contact"
        return text + (f", {c.guides} guides" if c.guides else "")


@dataclasses.dataclass(frozen=True)
class Point:
    """What was measured of a setting: errors pooled over all strokes, the worst stroke, times."""

    setting: Setting
    error: Errors
    worst: Errors
    time: Timing


def settings(quick: bool, stable: int) -> list[Setting]:
    """The grid: every integrator over step, iterations, contact nodes and guides."""
    make = lambda kind, **rest: BrushConfig(integrator=kind, **rest)  # noqa: E731
    grid = [Setting(BrushConfig())]
    # (stamp interval, stamps from solve to solve, iterations)
    plans = {
        "quasi_static": ((1e-3, 1, 1), (1e-3, 4, 1)),
        "projective": ((1e-3, 1, 1), (1e-3, 4, 1)),
        "implicit_euler": ((1e-3, 1, 3),),
    }
    if not quick:
        fast = [(1e-3, k, i) for k in (1, 2, 4, 8) for i in (1, 2)] + [(0.5e-3, 1, 1), (1e-3, 1, 4)]
        plans = {
            "quasi_static": fast,
            "projective": fast,
            "implicit_euler": [(1e-3, k, i) for k in (1, 4) for i in (1, 3)] + [(1e-3, 1, 8)],
        }
    for kind, plan in plans.items():
        for interval, stride, count in plan:
            grid.append(Setting(make(kind, iterations=count, stride=stride), interval))
    for count in () if quick else (3, 11):
        grid.append(Setting(make("quasi_static", contact_nodes=count)))
    for count in (64,) if quick else (32, 64, 128):
        grid.append(Setting(make("quasi_static", guides=count)))
    for kind in ("symplectic_euler",) if quick else ("symplectic_euler", "verlet"):
        for substeps in (stable,) if quick else (stable // 2, stable, 2 * stable):
            grid.append(Setting(make(kind, substeps=substeps)))
    # The default again, spelt out, is not another setting.
    spelt = dataclasses.replace(BrushConfig(), stride=BrushConfig().solve_stride)
    return [s for s in dict.fromkeys(grid) if s.config != spelt or s.interval != STAMP]


def references(options: Config, progress: Progress):
    """Reference motions by (shape, stroke), and the reference's own error: against half the step
    on two strokes of the first shape."""
    task = progress.add_task("reference", total=len(options.shapes) * len(options.strokes))
    motions, own = {}, []
    for shape in options.shapes:
        params = brush_of(shape, options.bristles)
        substeps = round(options.fineness * stable_substeps(params, 12))
        for kind in options.strokes:
            motions[shape, kind] = reference_of(params, kind, substeps)
            if shape == options.shapes[0] and kind in options.strokes[-2:]:
                finer = reference_of(params, kind, 2 * substeps)
                length = float(np.mean(params.length))
                own.append(errors(motions[shape, kind], finer, length))
            progress.advance(task)
    return motions, pooled(own)


def measure(setting: Setting, options: Config, motions) -> Point:
    """Errors of one setting on all strokes, and its time on the first."""
    found = []
    config = setting.config
    for (shape, kind), reference in motions.items():
        params = brush_of(shape, options.bristles)
        found.append(compare(config, params, kind, reference, setting.interval))
    with jax.enable_x64(True):
        stroke = stroke_of(options.strokes[0], setting.interval)
    params = single(brush_of(options.shapes[0], options.bristles))
    _, timing = timed(roll, setting.config, params, single(stroke), repeats=options.repeats)
    worst = Errors(*np.max([dataclasses.astuple(e) for e in found], axis=0))
    return Point(setting, pooled(found), worst, timing)


def side_questions(options: Config, progress: Progress) -> dict:
    """What the model leaves out: the softened length, and inertia, stroke by stroke.

    Returns:
      {"axial": Errors of the softened reference against true stiffness, "inertia": {stroke:
      (converged quasi-static, default)}}.
    """
    params = brush_of(options.shapes[0], 32)
    stable = stable_substeps(params, 12)
    stiff = dataclasses.replace(params, stretch=params.stretch * AXIAL_SOFTENING)
    length = float(np.mean(params.length))
    best = BrushConfig(iterations=4)
    task = progress.add_task("model", total=len(options.strokes) + 1)
    inertia, axial = {}, None
    for kind in options.strokes:
        soft = reference_of(params, kind, round(options.fineness * stable))
        converged = compare(best, params, kind, soft, 0.25e-3)
        inertia[kind] = (converged, compare(BrushConfig(), params, kind, soft))
        if kind in ("straight", options.strokes[-1]) and axial is None:
            duration = 0.05 if options.quick else DURATION
            steps = round(1.2 * stable_substeps(stiff, 12))
            hard = reference_of(stiff, kind, steps, duration)
            same = reference_of(params, kind, round(options.fineness * stable), duration)
            axial = errors(same, hard, length)
        progress.advance(task)
    progress.advance(task)
    return {"axial": axial, "inertia": inertia}


def frontier(points: list[Point], of) -> list[Point]:
    """The points that no other beats in both time and error."""
    best, kept = np.inf, []
    for point in sorted(points, key=lambda p: p.time.low):
        if of(point) < best:
            best = of(point)
            kept.append(point)
    return kept


def chart(points: list[Point], default: Point, own: Errors, peers: dict, options: Config, path):
    """Time per stroke against the error of tips and of force, one panel each."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(14.0, 6.2), sharey=True)
    panels = (
        ("tip", "rms error of the tips [% of bristle length]", TIP_BAR, "Where the tips are"),
        ("force", "rms error of the total normal force [%]", FORCE_BAR, "How hard they press"),
    )
    blown = 100.0
    for axis, (name, label, bar, title) in zip(axes, panels, strict=True):
        value = lambda p, name=name: min(np.nan_to_num(getattr(p.error, name), nan=blown), blown)  # noqa: E731,E501
        for (kind, text), color in zip(NAMES.items(), COLORS, strict=False):
            mine = [p for p in points if p.setting.config.integrator == kind]
            plain = [p for p in mine if not p.setting.config.guides]
            guided = [p for p in mine if p.setting.config.guides]
            for group, marker, note in ((plain, "o", text), (guided, "^", f"{text}, guides")):
                if group:
                    axis.scatter(
                        [value(p) for p in group], [p.time.low * 1e3 for p in group],
                        s=[22 + 14 * p.setting.config.iterations for p in group], marker=marker,
                        color=color, alpha=0.85, linewidth=0, label=note, zorder=3,
                    )  # fmt: skip
        line = frontier([p for p in points if value(p) < blown], value)
        axis.plot([value(p) for p in line], [p.time.low * 1e3 for p in line], color=INK, lw=0.8,
                  alpha=0.5, label="no setting is faster and better", zorder=2)  # fmt: skip
        axis.scatter([value(default)], [default.time.low * 1e3], s=260, facecolor="none",
                     edgecolor=INK, lw=1.6, label="default", zorder=4)  # fmt: skip
        for (text, peer), mark in zip(peers.items(), ("*", "P", "X", "D"), strict=False):
            axis.scatter([value(default)], [peer[0].low * 1e3], marker=mark, s=90, zorder=3,
                         color=COLORS[2], edgecolor=INK, lw=0.5, label=text)  # fmt: skip
        axis.axhline(FEEL, color=INK, lw=0.8, ls=(0, (4, 3)))
        axis.axvline(bar, color=INK, lw=0.8, ls=(0, (4, 3)))
        axis.axvspan(getattr(own, name) * 0.5, getattr(own, name), color="#efeae3", zorder=0)
        axis.text(getattr(own, name) * 0.52, 0.02, "reference's\nown error", fontsize=8,
                  transform=axis.get_xaxis_transform(), va="bottom")  # fmt: skip
        axis.text(bar * 1.05, 0.98, f"{bar:g} %", transform=axis.get_xaxis_transform(), va="top")
        axis.set(xscale="log", yscale="log", xlabel=label, title=title)
    axes[0].text(0.01, FEEL * 1.05, f"{FEEL:g} ms", transform=axes[0].get_yaxis_transform())
    stamps = round(DURATION / STAMP)
    axes[0].set_ylabel(
        f"time for a stroke of {DURATION * 1e3:.0f} ms, {options.bristles} bristles [ms]"
    )
    figure.legend(*axes[0].get_legend_handles_labels(), fontsize=9, loc="outside right center")
    figure.suptitle("Speed against accuracy of the bristle integrators", x=0.01, ha="left")
    figure.supxlabel(
        f"Larger dots: more iterations a stamp. Points at {blown:g} % have blown up. Errors are "
        f"rms over {len(options.shapes)} brushes x {len(options.strokes)} strokes, at all {stamps} "
        "stamps.\nThe default solves every second stamp: cheaper settings that pass both bars come "
        "closer to the bar of force when the hand turns fast.",
        fontsize=9, x=0.01, ha="left",
    )  # fmt: skip
    save_figure(figure, path)


def table(points, default, explicit, own, side, beside, peers, lower) -> None:
    """Prints what a reader decides by; the default in bold."""
    number = lambda x: f"{x:.3g}" if np.isfinite(x) and x < 1e3 else "blown up"  # noqa: E731
    chosen = frontier([p for p in points if p.error.finite], lambda p: p.error.tip)
    chosen = list(dict.fromkeys([*chosen, default, explicit]))
    rows, marked = [], None
    for point in sorted(chosen, key=lambda p: p.time.low):
        marked = len(rows) if point is default else marked
        rows.append(
            [str(point.setting), *(number(x) for x in dataclasses.astuple(point.error)),
             str(point.time), f"{point.time.low / default.time.low:.2f}"]
        )  # fmt: skip
    if peers:
        rows.append(["default, in turns with numba", "", "", "", str(beside), "1"])
    for name, (time, tip, force) in peers.items():
        rows.append([name, f"max {tip:.1e} mm", f"max {100 * force:.1e}", "", str(time),
                     f"{time.low / beside.low:.2f}"])  # fmt: skip
    total = max(lower["arithmetic_s"], lower["memory_s"])
    rows.append(["floor: arithmetic and memory", "", "", "", f"{total * 1e3:.3g}",
                 f"{total / default.time.low:.3f}"])  # fmt: skip
    starts = f"{lower['loops_per_solve']} loops, {lower['products_per_solve']} products a solve"
    rows.append([f"floor: starting {starts}", "", "", "",
                 f"{lower['starts_s'] * 1e3:.3g}",
                 f"{lower['starts_s'] / default.time.low:.3f}"])  # fmt: skip
    rows.append(["reference against half its step", *(number(x) for x in dataclasses.astuple(own)),
                 "", ""])  # fmt: skip
    for name, error in side:
        rows.append([name, *(number(x) for x in dataclasses.astuple(error)), "", ""])
    print_table(
        "Fastest settings for their error, and what they stand beside",
        ["setting", "tip [%]", "force [%]", "per bristle [%]", "min / median [ms]", "x default"],
        rows,
        marked,
    )


def main(options: Config) -> None:
    if options.quick:
        options = dataclasses.replace(
            options, bristles=64, shapes=options.shapes[:1], strokes=("zigzag",),
            fineness=1.2, repeats=5,
        )  # fmt: skip
    folder = results_folder("brush_accuracy", options.out)
    stable = max(stable_substeps(brush_of(s, options.bristles), 12) for s in options.shapes)
    with Progress(console=console, transient=True) as progress:
        motions, own = references(options, progress)
        grid = settings(options.quick, stable)
        points = []
        for setting in progress.track(grid, description="settings"):
            points.append(measure(setting, options, motions))
        side = side_questions(options, progress)
        default = points[0]

        params = brush_of(options.shapes[0], options.bristles)
        with jax.enable_x64(True):
            stroke = stroke_of(options.strokes[0])
        operations = brush_costs.scan_operations(
            default.setting.config, single(params), single(stroke)
        )
        lower = brush_costs.floor(
            default.setting.config, options.bristles,
            stroke.time.shape[0], operations,
        )  # fmt: skip
        beside, peers = brush_costs.numba_peers(
            default.setting.config, params, options.strokes[0], options.repeats
        )
        stability = None
        if options.stability:
            stability = brush_stability.run(options.quick, folder, progress)

    explicit = [p for p in points if p.setting.config.integrator == "symplectic_euler"]
    below = [p for p in explicit if p.error.tip <= default.error.tip]
    steady = [p for p in explicit if p.error.finite and p.error.tip < 100.0]
    match = min(below or steady or explicit, key=lambda p: p.time.low)
    ratio = match.time.low / default.time.low
    chart(points, default, own, peers, options, folder / "accuracy.png")
    rows = [("true hair against softened length", side["axial"])]
    for kind, (converged, usual) in side["inertia"].items():
        rows.append((f"{kind}: without inertia, converged", converged))
        rows.append((f"{kind}: default", usual))
    write_run(
        folder,
        options,
        {
            "points": points, "reference_error": own, "default": default, "explicit": match,
            "explicit_over_default": ratio, "model": side, "stability": stability,
            "default_beside_peers": beside,
            "peers": {k: {"time": v[0], "tip_mm": v[1], "force": v[2]} for k, v in peers.items()},
            "floor": lower,
        },
    )  # fmt: skip
    table(points, default, match, own, rows, beside, peers, lower)
    limit = max(lower["arithmetic_s"], lower["memory_s"])
    console.print(
        f"Explicit at the default's error or better takes {ratio:.1f} x the default's time. The "
        f"default is {default.time.low / limit:.1f} x above the floor of arithmetic and memory."
    )
    for name, peer in peers.items():
        console.print(f"{name}: {peer[0].low / beside.low:.2f} of the default's time.")
    if not peers:
        console.print("No numba beside it: pip install -e .[dev]")


if __name__ == "__main__":
    main(tyro.cli(Config, description=helped(__doc__)))
