# ruff: noqa: E731
"""How accurate are trajectory maps, what do they cost, and where does the time go?

Every setting draws the same strokes and is compared, on pixels of 0.1 mm, with all bristles drawn
at a quarter of the pixel and averaged down. OpenCV draws lines from the same tracks; another brush
of the same make is a yardstick.

    python -m experiments.map_accuracy            # about 5 minutes on one core
    python -m experiments.map_accuracy --quick    # about a minute
"""

import dataclasses
import functools
import math
import os
import time
from pathlib import Path

import cv2
import jax
import matplotlib.pyplot as plt
import numpy as np
import tyro
from matplotlib.ticker import LogLocator, NullFormatter
from rich.progress import Progress

from experiments import common, map_cases
from experiments.brush_costs import peak_flops, stream_bytes
from experiments.common import COLORS, INK, Timing, console, helped, print_table
from experiments.map_cases import SIDE, between, draw, finer, roll
from jaxbrush.brush import BrushConfig, guides, make_brush, rollout
from jaxbrush.raster import FORCE_UNIT, PIXEL, WIDTH, TrajectoryMaps, exact, trajectory_maps
from jaxbrush.raster.sweeps import sweeps_of

STROKES = ("light", "heavy", "turning", "crossing", "fast", "dab")
BAR = 16.0  # [ms], for the bristles and exact maps of a stroke
FINE = 4  # pixels of the reference along a pixel
MEASURES = ("coverage", "outline", "pressure", "time")
"""coverage: sum of differences over the footprint's area. outline: 1 - IoU of what is at least half
covered. pressure: rms over the rms of the reference, and time: rms, share of the stroke, both where
both cover at least half of a pixel. All in percent."""
# Name of a setting; its tag, text and marker on the chart.
FAMILIES = {
    "exact": ("exact, pixel {pixel:g} mm", "{pixel:g} mm", "exact, by pixel", "o"),
    "soft": ("soft, edge {edge:g} mm", "{edge:g} mm", "soft, by width of the edge", "o"),
    "bristles": ("exact, {bristles} bristles of {width:.2g} mm", "{bristles}",
                 "exact, fewer and wider bristles", "s"),
    "guides": ("exact, {guides} guides", "{guides}", "exact, by guides", "^"),
    "lines": ("OpenCV, lines in time order", "", "OpenCV, lines in time order", "*"),
    "runs": ("OpenCV, coverage only", "", "OpenCV, coverage only", "*"),
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Config:
    """Speed and accuracy of trajectory maps."""

    out: Path | None = None
    """Folder for charts and numbers [default: results/map_accuracy]."""
    quick: bool = False
    """Two strokes and one setting of a kind: the same code in about a minute."""
    strokes: tuple[str, ...] = STROKES
    """Strokes of the comparison, from experiments.map_cases."""
    bristles: int = 256
    """Bristles of the flat brush."""
    stamps: int = 200
    """Stamps of a stroke."""
    families: tuple[str, ...] = ("exact", "soft", "bristles", "guides")
    """What to vary; "exact" has to be among them."""
    rounds: int = 10
    """Warm calls of everything, in turn; the minimum and the median are kept."""
    seed: int = 7
    """Seed of the brush's irregularity."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """A point of the chart. Fewer bristles are some of the same brush, each wider by the square
    root of how many it stands for, so that they fill the same share of the ferrule."""

    family: str
    bristles: int
    width: float = WIDTH
    pixel: float = PIXEL
    edge: float | None = None
    guides: int = 0

    def __str__(self):
        return FAMILIES[self.family][0].format(**dataclasses.asdict(self))


def settings(options: Config) -> list[Setting]:
    """The default first, then the others."""
    count = options.bristles
    default = Setting("exact", count)
    change = functools.partial(dataclasses.replace, default)
    few = lambda n: change(family="bristles", bristles=count // n, width=WIDTH * n**0.5)
    soft = lambda edge: change(family="soft", edge=edge)
    led = lambda n: change(family="guides", guides=count // n)
    grid = [default, change(pixel=2 * PIXEL), few(4), led(4), soft(0.1)]
    rest = [change(pixel=PIXEL / 2), few(2), led(2), led(8), soft(0.05), soft(0.2), soft(0.4)]
    return [s for s in grid + rest * (not options.quick) if s.family in options.families]


sweep = jax.jit(lambda grid, track: sweeps_of(grid, track, 1, 0.0))
paint = jax.jit(lambda c, params, stroke, grid: trajectory_maps(grid, rollout(c, params, stroke)))


def layers(maps):
    """Coverage, and pressure and time where covered, (3, SIDE, SIDE), of maps of any pixel."""

    def fit(x):
        x = np.asarray(x, np.float64)
        n, few = max(x.shape[0] // SIDE, 1), max(SIDE // x.shape[0], 1)
        x = x.reshape(x.shape[0] // n, n, x.shape[1] // n, n).mean((1, 3))
        return np.repeat(np.repeat(x, few, 0), few, 1)

    fitted = np.stack([fit(maps.coverage), fit(maps.pressure), fit(maps.time)])
    fitted[1:] /= np.where(fitted[0] > 0.0, fitted[0], 1.0)
    return fitted


def compare(found, true):
    """MEASURES of layers (3, h, w), (4,)."""
    a, b = found[0] >= 0.5, true[0] >= 0.5
    both = a & b
    rms = lambda x: np.sqrt(np.mean(x[both] ** 2)) if both.any() else np.nan
    coverage = np.abs(found[0] - true[0]).sum() / true[0].sum()
    outline = 1.0 - both.sum() / max((a | b).sum(), 1)
    press = rms(found[1] - true[1]) / rms(true[1])
    return 100.0 * np.array([coverage, outline, press, rms(found[2] - true[2])])


pooled = lambda errors: np.sqrt(np.mean(np.square(errors), axis=0))  # over strokes


def lines_of(grid, track):
    """What OpenCV draws, prepared beforehand in its favour: each sweep in time order, both ends in
    1/16 pixels and (time, pressure, bristle + 1, 1); and the runs of each bristle, thinned to
    2 pixels a step, because anti-aliased rims add up where short lines meet."""
    s = jax.tree.map(np.asarray, sweep(grid, track))
    live = s.depth > 0.0
    ends = [s.x + s.low * s.ex, s.y + s.low * s.ey, s.x + s.high * s.ex, s.y + s.high * s.ey]
    ends = np.rint(16.0 * np.where(live, ends, 0.0)).astype(np.int32).transpose(1, 2, 0)
    force, moment = (s.press + s.high * s.gain) / FORCE_UNIT, s.time + s.high * s.span
    number = np.broadcast_to(np.arange(live.shape[1]) + 1.0, live.shape)
    value = np.stack([moment, force, number, np.ones_like(number)], axis=-1)[live]
    lines = [(p[:2], p[2:], v) for p, v in zip(ends[live].tolist(), value.tolist(), strict=True)]
    runs = []
    for b, stamps in enumerate(np.flatnonzero(x) for x in live.T):
        for run in np.split(stamps, np.flatnonzero(np.diff(stamps) > 1) + 1) if len(stamps) else ():
            points = np.concatenate([ends[run[:1], b, :2], ends[run, b, 2:]])
            way = np.abs(np.diff(points, axis=0)).sum() // 32
            kept = np.linspace(0, len(run), int(np.clip(way, 1, len(run))) + 1).astype(int)
            runs.append(points[kept][:, None])
    return lines, runs


def draw_lines(lines, runs):
    """Time, pressure and bristle of the latest line over each pixel, (h, w, 4), and anti-aliased
    coverage, (h, w): OpenCV smooths rims in 8-bit images only."""
    image, cover = np.zeros((SIDE, SIDE, 4), np.float32), np.zeros((SIDE, SIDE), np.uint8)
    for start, end, value in lines:
        cv2.line(image, start, end, value, round(WIDTH / PIXEL), cv2.LINE_8, 4)
    cv2.polylines(cover, runs, False, 255, round(WIDTH / PIXEL), cv2.LINE_AA, 4)
    return image, cover


def peer(case: dict):
    """OpenCV on one stroke, all and coverage alone: each (MEASURES, {what is timed: call})."""
    lines, runs = lines_of(case["grid"], case["track"])
    image, cover = draw_lines(lines, runs)
    share = np.where(image[..., 3] > 0.0, cover / 255.0, 0.0)
    time, press = np.moveaxis(image[..., :2], -1, 0) * share
    error = compare(layers(TrajectoryMaps(press, 0, 0, time, cover / 255.0, True)), case["true"])
    every, alone = lambda: draw_lines(lines, runs), lambda: draw_lines([], runs)
    return (error, {"maps": every}), (error * [1, 1, np.nan, np.nan], {"maps": alone})


def parts(case: dict, params) -> dict:
    """Calls of the parts of the heaviest stroke's maps, each compiled on its own."""
    grid, track, radius = case["grid"], case["track"], 0.5 * WIDTH / PIXEL
    stamps = track.time.shape[0]
    first = jax.jit(lambda g, t: (sweep(g, t), exact.table_of(sweep(g, t), radius)))
    both = jax.jit(lambda t: exact.images(t, stamps, grid.shape, radius))
    latest = jax.jit(lambda t: exact.images(t, stamps, grid.shape, radius)[0])
    values = jax.jit(lambda s, t, k: exact.values(s, t, k, radius))
    sweeps, table = first(grid, track)
    key = latest(table)
    return {
        "bristles (rollout)": lambda: roll(BrushConfig(), params, case["stroke"]),
        "sweeps and their table": lambda: first(grid, track),
        "keys of the latest sweep": lambda: latest(table),
        "keys and passes (sweep count)": lambda: both(table),
        "look-up of values": lambda: values(sweeps, table, key),
        "all maps": lambda: draw(grid, track),
        "bristles and maps in one": lambda: paint(BrushConfig(), params, case["stroke"], grid),
    }


def floor(case: dict) -> dict:
    """Least time of the exact maps of one stroke by arithmetic and by memory [s].

    Operations a pixel of a window: place beside the sweep 8, inside 4, moment, key and maximum 11;
    passes have two places and 6 more; look-up 25 a pixel of the map. Bytes: windows read and
    written, 10 numbers each (two times for passes); a table; key, row and two values a pixel.
    """
    s = jax.tree.map(np.asarray, sweep(case["grid"], case["track"]))
    live, radius = s.depth > 0.0, 0.5 * WIDTH / PIXEL
    length = (np.hypot(s.ex, s.ey) * (s.high - s.low))[live]
    windows, window, pixels = int(live.sum()), math.prod(exact.window_sides(radius)), SIDE * SIDE
    flops = windows * window * (23 + 30) + pixels * 25
    moved = 4 * (windows * (4 * window + 3 * 10) + 10 * live.size + pixels * (1 + 10 + 2))
    peak, stream = peak_flops(), stream_bytes()
    inside = float(np.sum(np.pi * radius**2 + 2.0 * radius * length)) / (windows * window)
    return {"sweeps_touching": windows, "share_inside": inside, "flops": flops, "bytes": moved,
            "peak_gflops": peak / 1e9, "stream_gbytes": stream / 1e9,
            "arithmetic_s": flops / peak, "memory_s": moved / stream}  # fmt: skip


def clock(jobs: dict, rounds: int, progress: Progress, slow: float = 0.1, calls: int = 4) -> dict:
    """Times jobs in turn, so that a busy machine slows all alike: {job: Timing}. Of `calls` in a
    row the first finds caches cold; what takes over `slow` [s] is called once in all. On one core
    it is the time that this process held the core."""
    now = time.process_time if len(cores()) == 1 else time.perf_counter
    taken = {job: [] for job in jobs}
    for _ in progress.track(range(rounds), description="timing"):
        for job, call in jobs.items():
            for _ in range(calls):
                if taken[job] and taken[job][0] >= slow:
                    break
                start = now()
                jax.block_until_ready(call())
                taken[job].append(now() - start)
    return {k: Timing(np.nan, min(t), float(np.median(t))) for k, t in taken.items()}


def cases_of(options: Config, params, progress: Progress) -> list[dict]:
    """Each stroke with its track, window, reference, and two errors of the default drawing: of
    another brush of the same make, and of 1 against 8 stamps for each (the order in a stamp)."""
    config, found = BrushConfig(), []
    other = make_brush(jax.random.key(options.seed + 1), config, "flat", options.bristles)
    for name in progress.track(options.strokes, description="references"):
        stroke = map_cases.stroke_of(name, options.stamps)
        track = roll(config, params, stroke)
        grid = map_cases.square_grid(track, WIDTH)
        true, plain = layers(draw(finer(grid, FINE), track)), layers(draw(grid, track))
        step = np.linalg.norm(np.diff(np.asarray(track.position[:, -1, :2]), axis=0), axis=1)
        spacing = float(step[np.asarray(track.contact[1:, -1])].mean())
        order = compare(plain, layers(draw(grid, between(track, 8))))
        apart = compare(layers(draw(grid, roll(config, other, stroke))), true)
        found.append({"name": name, "stroke": stroke, "track": track, "grid": grid, "true": true,
                      "spacing": spacing, "order": order, "apart": apart})  # fmt: skip
    return found


def work(setting: Setting, case: dict, params, options: Config):
    """One setting on one stroke: (MEASURES, {what is timed: call})."""
    config, grid, stroke = BrushConfig(guides=setting.guides), case["grid"], case["stroke"]
    if setting.bristles < options.bristles:
        params = guides.take(params, guides.choose(params, setting.bristles))
    if setting.pixel != PIXEL:
        grid = finer(grid, PIXEL / setting.pixel)
    track = roll(config, params, stroke)
    reach = 0.5 if setting.edge is None else map_cases.longest_of(track)
    maps = lambda: draw(grid, track, width=setting.width, edge=setting.edge, longest=reach)
    found = maps()
    if not bool(found.whole):
        console.print(f"[red]{setting}: gaps in {case['name']}, whose steps are too long")
    calls = {"maps": maps, "bristles": lambda: roll(config, params, stroke)}
    if setting == settings(options)[0]:
        calls["joint"] = lambda: paint(config, params, stroke, grid)
        calls["joint"]()
    return compare(layers(found), case["true"]), calls


def chart(points: list[dict], yardstick, options: Config, path: Path):
    """Time per stroke against the error of coverage, pressure and time, one panel each."""
    figure, axes = plt.subplots(1, 3, figsize=(15.0, 5.8), sharey=True)
    panels = ((0, "What is touched", "coverage, mean difference [% of footprint]"),
              (2, "How hard", "pressure, rms [% of rms]"),
              (3, "When", "time, rms [% of the stroke]"))  # fmt: skip
    default = points[0]
    for axis, (k, title, label) in zip(axes, panels, strict=True):
        for (family, (*_, text, marker)), color in zip(FAMILIES.items(), COLORS, strict=True):
            mine = [p for p in points if p["family"] == family]
            mine.sort(key=lambda p: float(p["tag"].split()[0] if p["tag"] else 0))
            x, y = [p["error"][k] for p in mine], [1e3 * p["joint"] for p in mine]
            axis.plot(x, y, color=color, marker=marker, lw=0.8, label=text, zorder=3,
                      ms=14 if marker == "*" else 6)  # fmt: skip
            for point, *at in zip(mine, x, y, strict=True):
                axis.annotate(point["tag"], at, (6, 5), textcoords="offset points", fontsize=8,
                              color=color)  # fmt: skip
        axis.plot(default["error"][k], 1e3 * default["joint"], "o", ms=16, mew=1.6,
                  mfc="none", mec=INK, label="default", zorder=5)  # fmt: skip
        axis.axhline(BAR, color=INK, lw=0.8, ls=(0, (4, 3)))
        axis.axvline(yardstick[k], color=INK, lw=0.8, ls=(0, (4, 3)))
        axis.text(yardstick[k], 0.99, "another brush of the same make ", rotation=90, fontsize=8,
                  transform=axis.get_xaxis_transform(), va="top", ha="right")  # fmt: skip
        axis.set(xscale="log", yscale="log", xlabel=label, title=title)
        axis.xaxis.set(major_locator=LogLocator(subs=(1, 2, 5)), major_formatter="{x:g}",
                       minor_formatter=NullFormatter())  # fmt: skip
    axes[0].text(0.01, BAR * 1.05, f"{BAR:g} ms", transform=axes[0].get_yaxis_transform())
    axes[0].set_ylabel("time for a stroke, bristles and maps [ms]")
    figure.legend(*axes[0].get_legend_handles_labels(), fontsize=9, loc="outside right center")
    figure.suptitle("Speed against accuracy of trajectory maps", x=0.01, ha="left")
    figure.supxlabel(
        f"{options.bristles} bristles, {options.stamps} stamps; errors on pixels of {PIXEL:g} mm "
        f"against {FINE} x {FINE} samples a pixel, rms over {len(options.strokes)} strokes; warm "
        "minima, mean over strokes.\nFewer bristles are each wider by the square root of how many "
        f"they stand for. Stars: the same bristles, drawn by cv2. {machine().capitalize()}.",
        fontsize=9, x=0.01, ha="left",
    )  # fmt: skip
    common.save_figure(figure, path)


def cores():
    return getattr(os, "sched_getaffinity", lambda _: range(os.cpu_count() or 1))(0)


def machine() -> str:
    return f"cores: {len(cores())}, load {os.getloadavg()[0]:.1f}"


def report(points, cases, yardstick, spent, lower, options: Config) -> None:
    number = lambda x: f"{x:.3g}" if np.isfinite(x) else ""
    cells = lambda errors: list(map(number, errors))
    columns = [f"{'1 - IoU' if m == 'outline' else m} [%]" for m in MEASURES]
    rows = [[p["name"], *cells(p["error"]), number(1e3 * p["maps"]), number(1e3 * p["joint"]),
             f"{p['joint'] / points[0]['joint']:.2f}"] for p in points]  # fmt: skip
    rows.append(["another brush of the same make", *cells(yardstick), "", "", ""])
    print_table(f"{options.bristles} bristles x {options.stamps} stamps; {machine()}",
                ["setting", *columns, "maps [ms]", "all [ms]", "x"], rows, 0)  # fmt: skip
    rows = [[c["name"], f"{c['spacing']:.2f}", *cells(e), number(c["order"][2]),
             number(c["order"][3]), number(1e3 * t)] for c, e, t in
            zip(cases, points[0]["each"], points[0]["joint_s"], strict=True)]  # fmt: skip
    print_table("The default, stroke by stroke; `order` is against 8 x the stamps, same pixel",
                ["stroke", "mm / stamp", *columns, "order: pressure", "time", "all [ms]"],
                rows)  # fmt: skip
    rows = [[k, str(t), f"{t.low / spent['bristles and maps in one'].low:.2f}"]
            for k, t in spent.items()]  # fmt: skip
    for kind, what, unit in (("arithmetic_s", "flops", "Mflop"), ("memory_s", "bytes", "MB")):
        rows.append([f"{lower[what] / 1e6:.0f} {unit}, floor", number(lower[kind] * 1e3), ""])
    print_table("Where the time of the heaviest stroke goes",
                ["part", "min / median [ms]", "share"], rows)  # fmt: skip


def main(options: Config) -> None:
    if options.quick:
        options = dataclasses.replace(options, strokes=options.strokes[1::3], rounds=5)
    folder = common.results_folder("map_accuracy", options.out)
    params = make_brush(jax.random.key(options.seed), BrushConfig(), "flat", options.bristles)
    points, jobs = [], {}

    def point(family, name, tag, found):
        for case, (_, calls) in zip(cases, found, strict=True):
            jobs.update({(name, kind, case["name"]): call for kind, call in calls.items()})
        points.append({"name": name, "family": family, "tag": tag, "each": [e for e, _ in found]})

    with Progress(console=console, transient=True) as progress:
        cases = cases_of(options, params, progress)
        for s in progress.track(settings(options), description="settings"):
            tag = FAMILIES[s.family][1].format(**dataclasses.asdict(s))
            point(s.family, str(s), tag, [work(s, case, params, options) for case in cases])
        peers = [peer(case) for case in cases]
        point("lines", FAMILIES["lines"][0], "", [p[0] for p in peers])
        point("runs", FAMILIES["runs"][0], "", [p[1] for p in peers])
        heavy = max(cases, key=lambda case: int(case["track"].contact.sum()))
        jobs |= {("part", name, ""): call for name, call in parts(heavy, params).items()}
        jax.block_until_ready([call() for (kind, *_), call in jobs.items() if kind == "part"])
        took = clock(jobs, options.rounds, progress)
        # What the bar is about again by itself, so that no other job has emptied the caches.
        bar = {job: call for job, call in jobs.items() if job[1] == "joint"}
        took |= clock(bar, 10 * options.rounds, progress)
    spent = {name: time for (kind, name, _), time in took.items() if kind == "part"}
    lower, rolled = floor(heavy), spent["bristles (rollout)"].low
    for p in points:
        low = {kind: [took.get((p["name"], kind, c["name"])) for c in cases]
               for kind in ("maps", "bristles", "joint")}  # fmt: skip
        low = {kind: [t.low if t else rolled for t in times] for kind, times in low.items()}
        p["maps_s"] = low["maps"]
        p["joint_s"] = low["joint"] if p is points[0] else np.add(low["maps"], low["bristles"])
        p |= {"maps": float(np.mean(p["maps_s"])), "joint": float(np.mean(p["joint_s"]))}
        p["error"] = pooled(p["each"])
    yardstick = pooled([case["apart"] for case in cases])
    chart(points, yardstick, options, folder / "accuracy.png")
    slowest = max(points[0]["joint_s"])
    passed = slowest * 1e3 <= BAR
    common.write_run(folder, options, {
        "measures": MEASURES, "points": points, "another_brush": yardstick, "parts": spent,
        "strokes": [{k: case[k] for k in ("name", "spacing", "order")} for case in cases],
        "floor": lower, "bar_ms": BAR, "slowest_s": slowest, "passed": passed,
        "measured_on": machine(),
    })  # fmt: skip
    report(points, cases, yardstick, spent, lower, options)
    inside, times = lower["share_inside"], spent["all maps"].low / lower["arithmetic_s"]
    console.print(
        f"{lower['sweeps_touching']} sweeps of {heavy['name']} touch; {100 * inside:.0f} % of the "
        f"windows is inside. All maps take {times:.1f} x the floor.\nBar, bristles and exact maps "
        f"within {BAR:g} ms: {points[0]['joint'] * 1e3:.1f} ms on average, "
        f"{slowest * 1e3:.1f} ms the slowest stroke, on {machine()}: "
        f"{'passed' if passed else 'NOT passed'}."
    )


if __name__ == "__main__":
    main(tyro.cli(Config, description=helped(__doc__)))
