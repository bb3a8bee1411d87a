"""Pictures of the brushes: every shape at rest, pressed, dragged and turning, and whole strokes.

python -m experiments.show_brush            # about 2 minutes
python -m experiments.show_brush --quick    # fewer bristles and shapes
"""

import dataclasses
import math
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import tyro
from PIL import Image
from rich.progress import track

from experiments.brush_drawing import PAPER, View, draw_hair, draw_handle, draw_track
from experiments.common import INK, console, helped, print_table, results_folder, timed, write_run
from jaxbrush.brush import SHAPES, BrushConfig, make_brush, rollout
from jaxbrush.brush.handle import poses, turned
from jaxbrush.stylus import make_stroke

CANVAS = (0.945, 0.920, 0.872)
ACTS = ("at rest", "pressed", "dragged", "turning")
PULLS = ("pull", "wave", "flick")
STROKE_WIDTH = {"round": 8.0, "flat": 12.0, "filbert": 12.0, "fan": 28.0, "rigger": 4.0}
"""Room for a stroke in the second picture [mm]."""


@dataclasses.dataclass(frozen=True)
class Config:
    """Pictures of brush shapes and of the strokes they make."""

    out: Annotated[Path | None, tyro.conf.arg(help="Folder for the pictures.")] = None
    """Folder for the pictures [default: results/show_brush]."""
    quick: bool = False
    """Two shapes with few bristles: the same code in under a minute."""
    bristles: int = 420
    """Bristles of a drawn brush."""
    stroke_bristles: int = 640
    """Bristles of a brush that paints a stroke."""
    seed: int = 3
    """Seed of the brushes' irregularity."""
    dots: int = 110
    """Resolution of the pictures, dots per inch."""


def _ease(x):
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def act(name: str, count: int = 140):
    """The hand in one column of the sheet: stamps 2 ms apart, drawn at the last one."""
    u = np.linspace(0.0, 1.0, count)
    zero = np.zeros(count)
    press = 0.62 * _ease(u / 0.35)
    rest = {"pressure": press, "altitude": math.radians(62.0), "azimuth": 0.0, "twist": math.pi / 2}
    x, y = zero, zero
    if name == "at rest":
        rest |= {"pressure": zero, "altitude": math.radians(80.0), "twist": 0.35}
    elif name == "pressed":
        rest |= {"pressure": 0.9 * press, "altitude": math.radians(82.0), "twist": 0.35}
    elif name == "dragged":
        x = 26.0 * u
    else:
        turn = 1.9 * (u - 0.2).clip(0.0)
        x, y = 14.0 * np.sin(turn), 14.0 * (1.0 - np.cos(turn)) * 0.9
        rest |= {"azimuth": 0.5 * turn, "twist": math.pi / 2 + 0.75 * turn}
    return make_stroke(np.stack([x, y], 1), 2e-3 * np.arange(count), **rest)


def pull(name: str, count: int = 480):
    """A stroke of the second picture, 60 to 70 mm long."""
    u = np.linspace(0.0, 1.0, count)
    twist, azimuth = math.pi / 2, 0.0
    x, y = 62.0 * u, np.zeros(count)
    if name == "pull":
        pressure = 0.06 + 0.62 * _ease(u / 0.3) * _ease((1.02 - u) / 0.45)
    elif name == "wave":
        y = 6.0 * np.sin(2.2 * np.pi * u)
        slope = np.arctan2(6.0 * 2.2 * np.pi * np.cos(2.2 * np.pi * u), 62.0)
        azimuth, twist = 0.6 * slope, math.pi / 2 + 0.4 * slope
        pressure = 0.38 + 0.24 * np.sin(2.2 * np.pi * u)
        pressure = pressure * _ease(u / 0.06) * _ease((1.0 - u) / 0.1)
    else:
        x, y = 60.0 * u**1.3, -5.0 * u**2
        pressure = 0.75 * _ease(u / 0.05) * (1.0 - u) ** 1.3
    return make_stroke(
        np.stack([x, y], 1), 1.5e-3 * np.arange(count), pressure,
        altitude=math.radians(58.0), azimuth=azimuth, twist=twist,
    )  # fmt: skip


@jax.jit
def _nodes(config: BrushConfig, params, stroke):
    """Rollout with every node in the track, the last handle pose, and its clamp points (3, b)."""
    track = rollout(config, params, stroke)
    pose = jax.tree.map(lambda x: x[-1], poses(params, stroke, config.approach))
    root = turned(pose.rotation, params.root) + pose.origin[:, None]
    return track, pose, root


def _measures(params):
    """Width and thickness of the ferrule [mm]."""
    span = np.ptp(np.asarray(params.root[:2]), axis=1)
    return float(span[0]), float(span[1])


def draw_cell(top, bottom, shape, name, config, params, seed, scale):
    """One brush in one act: the view from the side on `top`, its footprint on `bottom`."""
    (track, pose, root), timing = timed(_nodes, config, params, act(name), repeats=1)
    lift = 3.0 if name == "at rest" else 0.0
    nodes = np.concatenate([np.asarray(root)[None], np.asarray(track.position[-1])])
    nodes[:, 2] += lift
    origin = np.asarray(pose.origin) + [0.0, 0.0, lift]
    force = np.asarray(track.force.sum(1))
    tips = np.asarray(track.position[:, -1])
    view = View()

    middle = view(np.append(nodes[-1, :2].mean(1), 0.0))
    width, height = 44.0, 54.0
    moving = name in ("dragged", "turning")
    left, low = middle[0] - (0.40 if moving else 0.5) * width, middle[1] - 8.0
    top.set(xlim=(left, left + width), ylim=(low, low + height), aspect="equal")
    points = top.get_position().width * top.figure.get_figwidth() * 72.0 / width
    _ground(top, left, width, middle[1])
    if lift == 0.0:
        draw_track(top, tips[-90:], force[-90:], scale, 0.3 * points, view, alpha=0.13, fade=60)
    draw_hair(top, view, nodes, points, seed)
    draw_handle(top, view, shape, *_measures(params), np.asarray(pose.rotation), origin)

    recent = slice(-50, None) if moving else slice(-1, None)
    mid = tips[-1, :2].mean(1)
    aim = -3.0 if moving else 0.0
    bottom.set(xlim=(mid[0] + aim - 15.5, mid[0] + aim + 15.5), ylim=(mid[1] + 9, mid[1] - 9),
               aspect="equal")  # fmt: skip
    draw_track(bottom, tips[recent], force[recent], scale, 0.8, alpha=0.22, fade=40)
    down = force[-1] > 0.0
    share = np.clip(force[-1] / scale, 0.0, 1.5)
    bottom.scatter(*tips[-1, :2][:, ~down], s=1.3, color="#bfa982", linewidth=0, zorder=2)
    bottom.scatter(*tips[-1, :2][:, down], s=0.8 + 5.0 * share[down], color="#0f2547",
                   alpha=0.62, linewidth=0, zorder=3)  # fmt: skip
    return timing


def _ground(axis, left, width, level):
    """A canvas that comes out of the paper and fades to all sides."""
    x, y = np.linspace(-1.0, 1.0, 200), np.linspace(-1.0, 1.0, 120)[:, None]
    here = np.clip(1.0 - x**4, 0.0, 1.0) * np.clip(1.0 - np.abs(y) ** 2.5, 0.0, 1.0)
    color = np.array(PAPER) + (np.array(CANVAS) - np.array(PAPER)) * here[..., None]
    axis.imshow(color, extent=(left, left + width, level - 8.0, level + 9.0), origin="lower",
                zorder=0, aspect="auto", interpolation="bilinear")  # fmt: skip
    axis.set(aspect="equal")


def _bare(axis):
    axis.set_facecolor("none")
    axis.grid(False)
    axis.set(xticks=[], yticks=[])
    for side in axis.spines.values():
        side.set_visible(False)


def sheet(options: Config, shapes, path: Path) -> list:
    """Every shape in every act; returns rows of the table."""
    config = BrushConfig(contact_nodes=3, track_nodes=11)
    rows, columns = len(shapes), len(ACTS)
    figure = plt.figure(figsize=(2.9 * columns, 4.5 * rows + 0.5), layout="none")
    figure.set_facecolor(PAPER)
    table = []
    tall = 4.5 * rows + 0.5
    cells = [(r, c) for r in range(rows) for c in range(columns)]
    for r, c in track(cells, description="brushes", console=console, transient=True):
        shape = shapes[r]
        params = make_brush(jax.random.key(options.seed), config, shape, options.bristles)
        bottom = 1.0 - (0.5 + 4.5 * (r + 1)) / tall
        unit = 4.5 / tall
        high = figure.add_axes(
            (c / columns + 0.005, bottom + 0.27 * unit, 0.99 / columns, 0.73 * unit)
        )
        low = figure.add_axes(
            (c / columns + 0.02, bottom + 0.02 * unit, 0.96 / columns, 0.24 * unit)
        )
        _bare(high), _bare(low)
        scale = 2.5 * float(jnp.mean(3.0 * params.bending / params.length**3))
        timing = draw_cell(high, low, shape, ACTS[c], config, params, options.seed + r, scale)
        table.append([shape, ACTS[c], timing])
        if r == 0:
            figure.text((c + 0.5) / columns, 1.0 - 0.36 / tall, ACTS[c], ha="center", fontsize=15,
                        color=INK, family="serif", style="italic")  # fmt: skip
        if c == 0:
            figure.text(0.02, bottom + 0.93 * unit, shape, fontsize=17, color=INK, family="serif")
            low.plot([low.get_xlim()[0] + 1, low.get_xlim()[0] + 6], [low.get_ylim()[0] - 0.8] * 2,
                     color=INK, lw=1.2)  # fmt: skip
            low.text(
                low.get_xlim()[0] + 6.6, low.get_ylim()[0] - 0.8, "5 mm", fontsize=8, va="center"
            )
    save_picture(figure, path, options.dots)
    return table


def strokes(options: Config, shapes, path: Path) -> None:
    """Whole strokes seen from above: every bristle a line, darker where it presses harder."""
    config = BrushConfig(contact_nodes=3)
    params = {
        shape: make_brush(jax.random.key(options.seed), config, shape, options.stroke_bristles)
        for shape in shapes
    }
    wide = 72.0
    half = [6.2 + 0.5 * STROKE_WIDTH[shape] for shape in shapes]
    tall = 4.6 * 2.0 * sum(half) / wide
    figure, axes = plt.subplots(
        len(shapes), len(PULLS), figsize=(4.6 * len(PULLS) + 0.5, tall), layout="none",
        squeeze=False, height_ratios=half,
    )  # fmt: skip
    figure.set_facecolor(PAPER)
    figure.subplots_adjust(0.035, 0.0, 1.0, 1.0, 0.0, 0.0)
    run = jax.jit(rollout)
    rows = track(list(enumerate(shapes)), description="strokes", console=console, transient=True)
    for r, shape in rows:
        brush = params[shape]
        scale = 4.5 * float(jnp.mean(3.0 * brush.bending / brush.length**3))
        for axis, name in zip(axes[r], PULLS, strict=True):
            result = run(config, brush, pull(name))
            _bare(axis)
            place, force = np.asarray(result.position[:, -1]), np.asarray(result.force.sum(1))
            x, y = place[:, 0][force > 0.0], place[:, 1][force > 0.0]
            mid = 0.5 * (x.min() + x.max()), 0.5 * (y.min() + y.max())
            axis.set(xlim=(mid[0] - wide / 2, mid[0] + wide / 2),
                     ylim=(mid[1] + half[r], mid[1] - half[r]), aspect="equal")  # fmt: skip
            draw_track(axis, place, force, scale, 0.62, alpha=0.36)
        axes[r, 0].text(
            -0.03, 0.5, shape, transform=axes[r, 0].transAxes, rotation=90, va="center",
            ha="center", fontsize=14, family="serif", color=INK,
        )  # fmt: skip
    save_picture(figure, path, options.dots)


def save_picture(figure, path: Path, dots: int) -> None:
    """Saves a figure as a PNG with 256 colours, a third of the size; drawn at twice the size."""
    figure.set_dpi(2 * dots)
    figure.canvas.draw()
    pixels = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy())
    plt.close(figure)
    small = pixels.resize((pixels.width // 2, pixels.height // 2), Image.Resampling.LANCZOS)
    partial = path.with_name(path.name + ".partial")
    small.quantize(256, dither=Image.Dither.NONE).save(partial, "PNG", optimize=True)
    partial.replace(path)


def main(options: Config) -> None:
    shapes = SHAPES
    if options.quick:
        shapes = ("flat", "round")
        options = dataclasses.replace(options, bristles=96, stroke_bristles=128, dots=70)
    folder = results_folder("show_brush", options.out)
    table = sheet(options, shapes, folder / "brush_shapes.png")
    strokes(options, shapes, folder / "brush_strokes.png")
    write_run(folder, options, {"rollouts": [dict(shape=s, act=a, time=t) for s, a, t in table]})
    rows = [[s, a, f"{t.first:.1f}", f"{t.low * 1e3:.0f}"] for s, a, t in table]
    print_table(
        f"{options.bristles} bristles, 140 stamps; pictures in {folder}",
        ["brush", "act", "first call [s]", "warm [ms]"],
        rows,
    )


if __name__ == "__main__":
    main(tyro.cli(Config, description=helped(__doc__)))
