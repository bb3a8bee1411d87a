"""Reads a stroke out of its maps: the path and pressure of the hand, by gradient descent.

Known are the brush, the tilt and the times of the stamps. The fit starts with the true path
shifted and bent by 3 mm, and one pressure for all; moves to where the maps say the brush was; and
descends by Adam through soft maps and bristles. The maps that it reads are exact, of a brush that
is solved as in the fit and drawn at twice as many stamps.

python -m experiments.fit_stroke            # six strokes, about 8 minutes on one core
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

from experiments.common import console, helped, results_folder, write_run
from experiments.fit_drawing import Show, chart, film, report, strip
from experiments.fit_loss import PIXEL, Level, compare, target_of, unlike_exact
from experiments.fit_opening import SMOOTH, basis, moved
from jaxbrush.brush import BrushConfig, BrushParams, make_brush, rollout
from jaxbrush.raster import Grid, TrajectoryMaps, trajectory_maps
from jaxbrush.structs import config, state
from jaxbrush.stylus import KINDS, Stroke, random_stroke

SIDE = 38.4
"""Side of the canvas around a stroke [mm]."""
SCALES = (6, 12, 24, 48)
"""Control points of the cubic B-splines whose sum is a curve: Adam moves the whole stroke by the
first and bends it by the last."""
BAR = 0.5 * PIXEL
"""Success: rms path error below half a pixel [mm]."""
FOUND = ("s_curve", "arc", "scribble", "hook", "straight", "arc")
"""Kinds of the strokes, in turn; dabs are shorter than the way to go."""
OPENING = 20
"""Steps of the opening, for each of its smoothnesses."""
LEVELS = (
    Level(0.8, (1, 3), 80, (0.05, 0.02), (1, 1, 0.7, 0)),
    Level(0.4, (2, 6), 60, (0.03, 0.01), (1, 1, 0.7, 0.2)),
    Level(0.2, (2, 8), 40, (0.012, 0.002), (0.5, 0.5, 0.5, 0.5)),
)
"""Coarse to fine."""
AGAIN = 4
"""Descents at most after the first: it may end where hairs bend another way, which no slope
shows."""
AWAY = (0.15, 0.15, 0.3)
"""How far they begin from what was found: x, y [mm] and logit of the pressure, spread of control
points."""
ALIKE = 4e-3
"""Difference of exact maps at which a stroke counts as found."""
WEAK = 1e-3
"""Slope [1/mm] of the loss below which Adam's steps shrink: where a brush hardly touches, it would
else go as far along the noise as it goes elsewhere along the slope."""
PRIOR = 4e-3
"""Weight of the logarithm of the path's mean squared jerk: a hand is smooth, how smooth is not
known. Without it, ends that the maps hardly show go astray, with 100 times the jerk."""
CALM = 1e5
"""Mean squared jerk [(mm per stroke time^3)^2] below which a path is as smooth as any."""


@state
class Unknown:
    """What is looked for: control points at every scale. path: (k, 2) each [mm]. press: (k,)
    each, before the sigmoid."""

    path: tuple[jax.Array, ...]
    press: tuple[jax.Array, ...]


@config
class Setting:
    """What a fit compiles for. longest: step of a tip that soft maps reach [mm]."""

    brush: BrushConfig = BrushConfig(stride=1)
    scales: tuple[int, ...] = SCALES
    longest: float = 1.0


def _curve(points, stamps: int):
    total = 0.0
    for x in points:
        b = jnp.asarray(basis(stamps, x.shape[0]), x.dtype)
        total = total + jnp.matmul(b, x, precision="highest")
    return total


def with_curve(known: Stroke, path, press) -> Stroke:
    """A stroke of path (t, 2) [mm] and pressure given by its logit (t,); its timing, tilt and
    twist are those of `known`."""
    return dataclasses.replace(
        known, position=jnp.asarray(path, float), pressure=jax.nn.sigmoid(jnp.asarray(press, float))
    )


def stroke_of(unknown: Unknown, known: Stroke) -> Stroke:
    """The stroke of an unknown."""
    stamps = known.time.shape[0]
    return with_curve(known, _curve(unknown.path, stamps), _curve(unknown.press, stamps))


def unknown_of(curve: np.ndarray, scales) -> Unknown:
    """The control points of a curve (t, 3) of x, y and logit of the pressure: by the first scale
    what it can, by the next what is left."""
    points = []
    for k in scales:
        b = basis(len(curve), k)
        # A little ridge keeps the points tame where splines are short of stamps.
        found = np.linalg.solve(b.T @ b + 1e-3 * np.eye(k), b.T @ curve)
        curve = curve - b @ found
        points.append(jnp.asarray(found, float))
    return Unknown(path=tuple(x[:, :2] for x in points), press=tuple(x[:, 2] for x in points))


def astray(key, stroke: Stroke, distance: float):
    """The path of a stroke shifted and bent until it is `distance` off (rms)."""
    turn, bend = jax.random.split(key)
    angle = jax.random.uniform(turn, maxval=2 * np.pi)
    shift = np.array([np.cos(angle), np.sin(angle)])
    wobble = basis(len(stroke.time), 7) @ np.asarray(jax.random.normal(bend, (7, 2)))
    offset = shift + 0.7 * wobble
    rms = np.sqrt(np.mean(np.sum(offset**2, axis=1)))
    return np.asarray(stroke.position) + distance / rms * offset


def prior(unknown: Unknown, known: Stroke):
    """Penalty on the jerk of the path: Gaussian of unknown variance, so its logarithm."""
    position = _curve(unknown.path, known.time.shape[0])
    jerk = jnp.diff(position, n=3, axis=0) * float(known.time.shape[0] - 1) ** 3
    return PRIOR * jnp.log(CALM + jnp.mean(jnp.sum(jerk**2, axis=1)))


Tools = namedtuple("Tools", "draw slope move optimizer")
"""The compiled parts of a fit; the brush's gradient, slow to compile, serves every level."""


def rates(levels):
    """The learning rate of each step: falls within a level, by a cosine."""
    ends = np.cumsum([level.steps for level in levels])[:-1]
    parts = [optax.cosine_decay_schedule(a.rate[0], a.steps, a.rate[1] / a.rate[0]) for a in levels]
    return optax.join_schedules(parts, [int(n) for n in ends])


def make_tools(setting: Setting, levels) -> Tools:
    """Compiled functions of a fit: stroke to track, slope of the loss of a track, one update."""
    optimizer = optax.chain(optax.zero_nans(), optax.adam(rates(levels), b1=0.8, b2=0.95, eps=WEAK))

    def draw(stroke, brush):
        return rollout(setting.brush, brush, stroke)

    def slope(pixel, origin, target, track):
        def loss(position, force):
            drawn = dataclasses.replace(track, position=position, force=force)
            return compare(pixel, setting.longest, origin, target, drawn)

        return jax.value_and_grad(loss, (0, 1), has_aux=True)(track.position, track.force)

    def move(unknown, memory, known, brush, slope, share):
        def drawn(unknown):
            track = draw(stroke_of(unknown, known), brush)
            return (track.position, track.force), prior(unknown, known)

        _, back = jax.vjp(drawn, unknown)
        (gradient,) = back((slope, jnp.ones_like(known.time[0])))
        # Optax raises floats to whole powers.
        with jax.numpy_dtype_promotion("standard"):
            step, memory = optimizer.update(gradient, memory, unknown)
        step = jax.tree.map(jnp.multiply, step, share)
        return optax.apply_updates(unknown, step), memory, gradient

    return Tools(jax.jit(draw), jax.jit(slope, static_argnums=0), jax.jit(move), optimizer)


_shape = jax.jit(stroke_of)


def opened(tools: Tools, level, case: "Case"):
    """Moves the start of a case to where its maps say the brush was, smoothly and less so.

    Returns:
      (curves, curve): OPENING of them, (t, 3), and that of these whose maps are the most alike.
    """
    target = target_of(level, case.exact)
    ways = []
    for smooth in SMOOTH:
        curve, passed = np.asarray(case.start, float), []
        for _ in range(OPENING):
            track = tools.draw(with_curve(case.true, curve[:, :2], curve[:, 2]), case.brush)
            maps = exact_maps(case.origin, track)
            passed.append((float(unlike_exact(maps, target)), curve))
            curve = moved(curve, maps, case.exact, smooth)
        ways.append(passed)
    best = min(ways, key=lambda passed: min(loss for loss, _ in passed))
    return [curve for _, curve in best], min(best, key=lambda x: x[0])[1]


def descend(setting: Setting, tools: Tools, levels, case: "Case", curve, watch) -> Stroke:
    """Descends from a curve (t, 3) through the levels."""
    known, brush, origin = case.true, case.brush, case.origin
    unknown = unknown_of(curve, setting.scales)
    memory = tools.optimizer.init(unknown)
    for level in levels:
        target = target_of(level, case.exact)
        share = jax.tree.map(jnp.float32, Unknown(path=level.shares, press=level.shares))
        for _ in range(level.steps):
            stroke = _shape(unknown, known)
            track = tools.draw(stroke, brush)
            (loss, whole), slope = tools.slope(level.pixel, origin, target, track)
            watch(stroke, loss, whole)
            unknown, memory, _ = tools.move(unknown, memory, known, brush, slope, share)
    return _shape(unknown, known)


def disturbed(draw: np.random.Generator, stroke: Stroke, early: bool) -> np.ndarray:
    """The curve of a stroke, moved smoothly by `AWAY`; or its beginning, by twice that."""
    press = np.clip(np.asarray(stroke.pressure, float), 1e-4, 1.0 - 1e-4)
    curve = np.column_stack([np.asarray(stroke.position), np.log(press / (1.0 - press))])
    away = basis(len(curve), 9) @ (draw.normal(size=(9, 3)) * AWAY)
    if early:
        away *= 2.0 * np.exp(-np.linspace(0.0, 6.0, len(curve)))[:, None]
    return curve + away


def fit(
    setting: Setting, tools: Tools, levels, case: "Case", watch=lambda *_: None, again: int = AGAIN,
    tick=lambda: None,
) -> Stroke:  # fmt: skip
    """Opens from the start of a case, descends through the levels, and again from near what was
    found while its maps are not those that were read.

    Args:
      watch: called with (stroke, loss, whole) at every step of the opening, whose loss is None, and
        of the first descent. again: descents at most after it. tick: called at their steps.

    Returns:
      The stroke whose exact maps are the most alike.
    """
    curves, curve = opened(tools, levels[0], case)
    for x in curves:
        watch(with_curve(case.true, x[:, :2], x[:, 2]), None, True)
    target, draw = target_of(levels[-1], case.exact), np.random.default_rng(0)

    def unlike(stroke) -> float:
        maps = exact_maps(case.origin, tools.draw(stroke, case.brush))
        return float(unlike_exact(maps, target))

    found = descend(setting, tools, levels, case, curve, watch)
    for number in range(again):
        if unlike(found) < ALIKE:
            break
        curve = disturbed(draw, found, early=number % 2 == 1)
        other = descend(setting, tools, levels, case, curve, lambda *_: tick())
        found = min(found, other, key=unlike)
    return found


def errors(found: Stroke, case: "Case") -> dict:
    """Path error rms and largest [mm] and pressure error rms, over the stamps at which the true
    brush touches (where no bristle does, the maps say nothing); firm: path error rms where the
    pen is pressed beyond 0.1."""
    off = np.linalg.norm(np.asarray(found.position) - np.asarray(case.true.position), axis=1)
    press = np.asarray(found.pressure) - np.asarray(case.true.pressure)
    firm = np.asarray(case.true.pressure) > 0.1
    rms = lambda x: float(np.sqrt(np.mean(x**2)))  # noqa: E731
    return {
        "path": rms(off[case.touching]),
        "most": float(off[case.touching].max()),
        "press": rms(press[case.touching]),
        "firm": rms(off[firm]),
    }


@dataclasses.dataclass(frozen=True)
class Case:
    """A stroke to find: its brush, the truth, when it touches (t,), its exact maps and where they
    lie, a start (t, 3): x, y [mm] and logit of the pressure."""

    brush: BrushParams
    true: Stroke
    touching: np.ndarray
    exact: TrajectoryMaps
    origin: jax.Array
    start: np.ndarray


@jax.jit
def exact_maps(origin, track) -> TrajectoryMaps:
    """The maps to read: bristles of a track at PIXEL, on a square at origin."""
    n = round(SIDE / PIXEL)
    return trajectory_maps(Grid(shape=(n, n), origin=origin, pixel=PIXEL), track)


_brushed = jax.jit(rollout)
_invented = jax.jit(random_stroke, static_argnums=(1, 3))


def make_case(setting: Setting, options: "Config", seed: int) -> Case:
    """Draws stroke number `seed`, at twice the stamps of the fit, of which the brush is solved at
    every second: solved at others, it would trail up to 0.1 mm elsewhere."""
    key = jax.random.fold_in(jax.random.key(options.seed), seed)
    kind = KINDS.index(FOUND[seed % len(FOUND)])
    hand, hair, away = jax.random.split(key, 3)
    brush = make_brush(hair, setting.brush, options.shape, options.bristles)
    fine = _invented(hand, 2 * options.stamps - 1, options.extent, kind)
    twice = dataclasses.replace(setting.brush, stride=2 * setting.brush.solve_stride)
    track = _brushed(twice, brush, fine)
    contact = np.asarray(track.contact)[:, -1]
    place = np.moveaxis(np.asarray(track.position)[:, -1, :2], 1, 2)[contact]
    corner = 0.5 * (place.min(0) + place.max(0)) - 0.5 * SIDE
    origin = jnp.asarray(np.round(corner / PIXEL) * PIXEL, float)
    true = jax.tree.map(lambda x: x[::2], fine)
    press = np.full(options.stamps, np.log(options.pressure / (1.0 - options.pressure)))
    path = astray(away, true, options.distance)
    return Case(
        brush=brush,
        true=true,
        touching=contact[::2].any(1),
        exact=exact_maps(origin, track),
        origin=origin,
        start=np.concatenate([path, press[:, None]], axis=1),
    )


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


def run(setting: Setting, tools: Tools, case: Case, tick=lambda: None):
    """Fits one case; returns the row of numbers, and the stroke at every step of the opening and
    the first descent, and in the end."""
    seen, losses, holes = [], [], 0

    def watch(stroke, loss, whole):
        nonlocal holes
        seen.append(stroke)
        if loss is not None:
            losses.append(float(loss))
        holes += not whole
        tick()

    start = time.perf_counter()
    seen.append(fit(setting, tools, LEVELS, case, watch, tick=tick))
    seconds = time.perf_counter() - start
    steps = [errors(stroke, case) for stroke in seen]
    row = {"start": steps[0], "opened": steps[OPENING], "first": steps[-2], "end": steps[-1]}
    row |= {"seconds": seconds, "holes": holes, "loss": losses}
    return row | {"path_by_step": [e["path"] for e in steps]}, seen


def _redrawn(setting: Setting, case: Case, stroke):
    return exact_maps(case.origin, _brushed(setting.brush, case.brush, stroke))


def main(options: Config) -> None:
    if options.quick:
        options = dataclasses.replace(options, strokes=1)
    folder = results_folder("fit_stroke", options.out)
    setting = Setting()
    tools = make_tools(setting, LEVELS)
    total = OPENING + sum(level.steps for level in LEVELS)
    rows, shows = [], []
    with Progress(console=console, transient=True) as bar:
        most = OPENING + (1 + AGAIN) * (total - OPENING)
        task = bar.add_task("steps", total=options.strokes * most)
        for seed in range(options.strokes):
            case = make_case(setting, options, seed)
            row, curves = run(setting, tools, case, lambda: bar.advance(task))
            bar.update(task, completed=(seed + 1) * most)
            row = {"stroke": f"{FOUND[seed % len(FOUND)].replace('_', ' ')} {seed}", **row}
            rows.append(row)
            console.print(f"{row['stroke']}: {row['end']['path']:.4f} mm, {row['seconds']:.0f} s")
            again = partial(_redrawn, setting, case)
            shows.append(Show(row["stroke"], case, curves, row["path_by_step"], again, SIDE))
    shows = sorted(shows, key=lambda show: show.errors[-1])[:3]
    strip(shows, (0, 1, OPENING, OPENING + 60, total), folder / "fit_stroke.png")
    film(shows[0], total, folder / "fit_stroke.gif")
    chart(rows, OPENING, LEVELS, BAR, folder / "fit_error.png")
    found = sum(row["end"]["path"] < BAR for row in rows)
    write_run(folder, options, {"found": found, "bar": BAR, "levels": LEVELS, "strokes": rows})
    title = f"{found} of {len(rows)} strokes found to half a pixel: rms path error below {BAR:g} mm"
    report(rows, PIXEL, f"{title}; pictures in {folder}")


if __name__ == "__main__":
    main(tyro.cli(Config, description=helped(__doc__)))
