"""Reads a stroke out of its maps: the path and pressure of the hand, by gradient descent.

Known are the brush, the tilt and the times of the stamps; the maps are the exact ones, the fit
draws soft ones. It starts with the true path shifted and bent by 3 mm, and one pressure for all.

python -m experiments.fit_stroke            # six strokes, about 10 minutes on one core
python -m experiments.fit_stroke --quick    # one of them; most of its time is the compiler's
"""

import dataclasses
import time
from collections import namedtuple
from functools import partial
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from rich.progress import Progress

from experiments.common import console, results_folder, write_run
from experiments.fit_drawing import Show, chart, film, report, strip
from experiments.fit_loss import PIXEL, Level, compare, target_of
from jaxbrush.brush import BrushConfig, BrushParams, make_brush, rollout
from jaxbrush.raster import Grid, TrajectoryMaps, trajectory_maps
from jaxbrush.structs import config, state
from jaxbrush.stylus import KINDS, Stroke, random_stroke

SIDE = 51.2
"""Side of the canvas around a stroke [mm]."""
SCALES = (6, 12, 24, 48)
"""Control points of the cubic B-splines whose sum is a curve: Adam moves the whole stroke by the
first and bends it by the last."""
PRESSED = 0.1
"""A pen pressed less leaves next to nothing in the maps; its path is not asked for."""
BAR = 0.5 * PIXEL
"""Success: rms path error below half a pixel [mm]."""
FOUND = ("s_curve", "arc", "scribble", "hook", "straight", "arc")
"""Kinds of the strokes, in turn; dabs are shorter than the way to go."""
EVEN = (0.5, 0.5, 0.5, 0.5), (1, 1, 1, 1)
# fmt: off
LEVELS = (
    Level(0.8, 0.8, 1.6, (0.5, 1), (0, 1), 80, (0.3, 0.1), (1, 0.5, 0, 0), (0.5, 0.3, 0, 0)),
    Level(0.8, 0.8, 1.0, (1, 3), (0.5, 1), 60, (0.1, 0.06), (0.7, 0.7, 0.5, 0), (1, 0.7, 0, 0)),
    Level(0.8, 0.8, 0.5, (1, 4), (1, 0.2), 60, (0.06, 0.03), (.7, .7, .5, .2), (1, .7, .3, 0)),
    Level(0.4, 0.4, 0.0, (2, 6), (1, 0.05), 80, (0.04, 0.01), (.5, .5, .5, .3), (1, 1, .5, .2)),
    Level(0.2, 0.2, 0.0, (2, 8), (1, 0), 70, (0.015, 0.003), *EVEN),
    Level(0.1, 0.1, 0.0, (2, 8), (1, 0), 40, (0.004, 0.0005), *EVEN),
)
# fmt: on
"""Coarse to fine. First where the brush was in each part of the stroke's time, which a stroke far
away feels too; then the images."""
PRIOR = 1e-10
"""Weight of the squared jerk [mm per stroke time^3] of the path where the pen barely presses: it
leaves no trace there, and goes on as it came."""


@state
class Unknown:
    """What is looked for: control points at every scale. path: (k, 2) each [mm]. press: (k,)
    each, before the sigmoid."""

    path: tuple[jax.Array, ...]
    press: tuple[jax.Array, ...]


@config
class Setting:
    """What a fit compiles for. longest: step of a tip that soft maps reach [mm]."""

    brush: BrushConfig = BrushConfig()
    scales: tuple[int, ...] = SCALES
    longest: float = 1.0


def basis(stamps: int, count: int) -> np.ndarray:
    """Cubic B-splines with evenly spaced knots, (stamps, count); rows sum to 1."""
    at = np.linspace(0.0, count - 3.0, stamps)[:, None] - np.arange(-1, count - 1)[None]
    far = np.abs(at)
    near = 2.0 / 3.0 - far**2 + 0.5 * far**3
    return np.where(far < 1.0, near, np.clip(2.0 - far, 0.0, None) ** 3 / 6.0)


def _curve(points, stamps: int):
    total = 0.0
    for x in points:
        b = jnp.asarray(basis(stamps, x.shape[0]), x.dtype)
        total = total + jnp.matmul(b, x, precision="highest")
    return total


def stroke_of(unknown: Unknown, known: Stroke) -> Stroke:
    """The stroke of an unknown; its timing, tilt and twist are those of `known`."""
    stamps = known.time.shape[0]
    return dataclasses.replace(
        known,
        position=_curve(unknown.path, stamps),
        pressure=jax.nn.sigmoid(_curve(unknown.press, stamps)),
    )


def start_at(position, pressure: float, scales) -> Unknown:
    """An unknown whose path is `position` (t, 2) and whose pressure is constant."""
    left, path = np.asarray(position, float), []
    for k in scales:
        b = basis(len(left), k)
        # A little ridge keeps the points tame where splines are short of stamps.
        points = np.linalg.solve(b.T @ b + 1e-3 * np.eye(k), b.T @ left)
        left = left - b @ points
        path.append(jnp.asarray(points, float))
    level = float(np.log(pressure / (1.0 - pressure)))
    press = [jnp.full(k, level if i == 0 else 0.0) for i, k in enumerate(scales)]
    return Unknown(path=tuple(path), press=tuple(press))


def astray(key, stroke: Stroke, distance: float):
    """The path of a stroke shifted and bent until it is `distance` off (rms) where it presses."""
    turn, bend = jax.random.split(key)
    angle = jax.random.uniform(turn, maxval=2 * np.pi)
    shift = np.array([np.cos(angle), np.sin(angle)])
    wobble = basis(len(stroke.time), 7) @ np.asarray(jax.random.normal(bend, (7, 2)))
    offset = shift + 0.7 * wobble
    pressed = np.asarray(stroke.pressure) > PRESSED
    rms = np.sqrt(np.mean(np.sum(offset**2, axis=1)[pressed]))
    return np.asarray(stroke.position) + distance / rms * offset


def prior(unknown: Unknown, known: Stroke):
    """Penalty on the jerk of the path where the pen barely presses."""
    stroke = stroke_of(unknown, known)
    count = stroke.time.shape[0] - 1
    jerk = jnp.diff(stroke.position, n=3, axis=0) * float(count) ** 3
    light = jax.lax.stop_gradient(jnp.exp(-stroke.pressure[1:-2] / 0.04))
    return PRIOR * jnp.mean(light * jnp.sum(jerk**2, axis=1))


Tools = namedtuple("Tools", "draw slope move optimizer")
"""The compiled parts of a fit; the brush's gradient, slow to compile, serves every level."""


def rates(levels):
    """The learning rate of each step: falls within a level, by a cosine."""
    ends = np.cumsum([level.steps for level in levels])[:-1]
    parts = [optax.cosine_decay_schedule(a.rate[0], a.steps, a.rate[1] / a.rate[0]) for a in levels]
    return optax.join_schedules(parts, [int(n) for n in ends])


def make_tools(setting: Setting, levels) -> Tools:
    """Compiled functions of a fit: (unknown, known, brush) to track, its slope, one update."""
    optimizer = optax.chain(optax.zero_nans(), optax.adam(rates(levels), b1=0.8, b2=0.95))

    def draw(unknown, known, brush):
        return rollout(setting.brush, brush, stroke_of(unknown, known))

    def slope(pixel, edge, origin, target, track):
        def loss(position, force):
            drawn = dataclasses.replace(track, position=position, force=force)
            return compare(pixel, edge, setting.longest, origin, target, drawn)

        return jax.value_and_grad(loss, (0, 1), has_aux=True)(track.position, track.force)

    def move(unknown, memory, known, brush, slope, share):
        def drawn(unknown):
            track = draw(unknown, known, brush)
            return (track.position, track.force), prior(unknown, known)

        _, back = jax.vjp(drawn, unknown)
        (gradient,) = back((slope, jnp.ones_like(known.time[0])))
        # Optax raises floats to whole powers.
        with jax.numpy_dtype_promotion("standard"):
            step, memory = optimizer.update(gradient, memory, unknown)
        step = jax.tree.map(jnp.multiply, step, share)
        return optax.apply_updates(unknown, step), memory, gradient

    return Tools(jax.jit(draw), jax.jit(slope, static_argnums=(0, 1)), jax.jit(move), optimizer)


def fit(tools: Tools, levels, case: "Case", watch=lambda *_: None) -> Unknown:
    """Descends from the start through the levels; `watch(unknown, loss, whole)` sees every step."""
    unknown, memory = case.start, tools.optimizer.init(case.start)
    known, brush, origin = case.true, case.brush, case.origin
    for level in levels:
        target = target_of(level, case.exact)
        share = jax.tree.map(jnp.float32, Unknown(path=level.path, press=level.press))
        for _ in range(level.steps):
            drawn = tools.draw(unknown, known, brush)
            (loss, whole), slope = tools.slope(level.pixel, level.edge, origin, target, drawn)
            watch(unknown, loss, whole)
            unknown, memory, _ = tools.move(unknown, memory, known, brush, slope, share)
    return unknown


def errors(found: Stroke, true: Stroke) -> dict:
    """Path error rms and largest [mm] and pressure error rms, where the true pen presses."""
    pressed = np.asarray(true.pressure) > PRESSED
    off = np.linalg.norm(np.asarray(found.position) - np.asarray(true.position), axis=1)[pressed]
    press = (np.asarray(found.pressure) - np.asarray(true.pressure))[pressed]
    rms = lambda x: float(np.sqrt(np.mean(x**2)))  # noqa: E731
    return {"path": rms(off), "most": float(off.max()), "press": rms(press)}


@state
class Case:
    """A stroke to find: its brush, the truth, its exact maps and where they lie, a start."""

    brush: BrushParams
    true: Stroke
    exact: TrajectoryMaps
    origin: jax.Array
    start: Unknown


@jax.jit
def exact_maps(origin, track) -> TrajectoryMaps:
    """The maps to read: bristles of a track at PIXEL, on a square at origin."""
    n = round(SIDE / PIXEL)
    return trajectory_maps(Grid(shape=(n, n), origin=origin, pixel=PIXEL), track)


_brushed = jax.jit(rollout)
_invented = jax.jit(random_stroke, static_argnums=(1, 3))


def make_case(setting: Setting, options: "Config", seed: int) -> Case:
    """Draws stroke number `seed`; the truth moves in steps half as long as the fit's."""
    key = jax.random.fold_in(jax.random.key(options.seed), seed)
    kind = KINDS.index(FOUND[seed % len(FOUND)])
    hand, hair, away = jax.random.split(key, 3)
    brush = make_brush(hair, setting.brush, options.shape, options.bristles)
    fine = _invented(hand, 2 * options.stamps - 1, options.extent, kind)
    track = _brushed(setting.brush, brush, fine)
    place = np.moveaxis(np.asarray(track.position)[:, -1, :2], 1, 2)
    place = place[np.asarray(track.contact)[:, -1]]
    corner = 0.5 * (place.min(0) + place.max(0)) - 0.5 * SIDE
    origin = jnp.asarray(np.round(corner / PIXEL) * PIXEL, float)
    exact = exact_maps(origin, track)
    true = jax.tree.map(lambda x: x[::2], fine)
    start = start_at(astray(away, true, options.distance), options.pressure, setting.scales)
    return Case(brush=brush, true=true, exact=exact, origin=origin, start=start)


@dataclasses.dataclass(frozen=True)
class Config:
    """Finds path and pressure of strokes from their trajectory maps."""

    out: Annotated[Path | None, tyro.conf.arg(help="Folder for pictures and numbers.")] = None
    """Folder [default: results/fit_stroke]."""
    quick: bool = False
    """One stroke: the same code."""
    strokes: int = 6
    """How many random strokes."""
    shape: str = "filbert"
    """Shape of the brush."""
    bristles: int = 32
    """Bristles of the brush."""
    stamps: int = 160
    """Stamps of a stroke, evenly spaced in time."""
    extent: float = 20.0
    """Square that strokes lie in [mm]."""
    distance: float = 3.0
    """How far off the path starts, rms [mm]."""
    pressure: float = 0.4
    """Pressure that the fit starts with."""
    seed: int = 0
    """Seed of strokes, brushes and starts."""


def run(tools: Tools, case: Case, tick=lambda: None):
    """Fits one case; returns the row of numbers and the curves of every step."""
    seen, losses, holes = [], [], 0

    def watch(unknown, loss, whole):
        nonlocal holes
        seen.append(unknown)
        losses.append(float(loss))
        holes += not whole
        tick()

    start = time.perf_counter()
    unknown = fit(tools, LEVELS, case, watch)
    seconds = time.perf_counter() - start
    curves = [stroke_of(u, case.true) for u in [*seen, unknown]]
    steps = [errors(curve, case.true) for curve in curves]
    row = {"start": steps[0], "end": steps[-1], "seconds": seconds, "holes": holes}
    row |= {"path_by_step": [e["path"] for e in steps], "loss": losses}
    return row, curves


def _redrawn(setting: Setting, case: Case, stroke):
    return exact_maps(case.origin, _brushed(setting.brush, case.brush, stroke))


def main(options: Config) -> None:
    if options.quick:
        options = dataclasses.replace(options, strokes=1)
    folder = results_folder("fit_stroke", options.out)
    setting = Setting()
    tools = make_tools(setting, LEVELS)
    total = sum(level.steps for level in LEVELS)
    rows, shows = [], []
    with Progress(console=console, transient=True) as bar:
        task = bar.add_task("steps", total=options.strokes * total)
        for seed in range(options.strokes):
            case = make_case(setting, options, seed)
            row, curves = run(tools, case, lambda: bar.advance(task))
            row = {"stroke": f"{FOUND[seed % len(FOUND)].replace('_', ' ')} {seed}", **row}
            rows.append(row)
            console.print(f"{row['stroke']}: {row['end']['path']:.4f} mm, {row['seconds']:.0f} s")
            again = partial(_redrawn, setting, case)
            shows.append(Show(row["stroke"], case, curves, row["path_by_step"], again, SIDE))
    shows = sorted(shows, key=lambda show: show.errors[-1])[:3]
    strip(shows, (0, 15, 60, 180, total), folder / "fit_stroke.png")
    film(shows[0], total, folder / "fit_stroke.gif")
    chart(rows, LEVELS, BAR, folder / "fit_error.png")
    found = sum(row["end"]["path"] < BAR for row in rows)
    write_run(folder, options, {"found": found, "bar": BAR, "levels": LEVELS, "strokes": rows})
    title = f"{found} of {len(rows)} strokes found to half a pixel: rms path error below {BAR:g} mm"
    report(rows, PIXEL, f"{title}; pictures in {folder}")


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
