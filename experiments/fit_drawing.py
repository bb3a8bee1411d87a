"""Pictures of a fit: the maps that a stroke makes, the path over them, and the error by step."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection
from PIL import Image

from experiments.brush_drawing import PAINT, PAPER, ramp
from experiments.common import COLORS, INK, print_table, save_figure

HAND = "#d2431f"
TRUTH = "#1c1a17"


def ink(pressure, coverage, dark: float):
    """Maps (h, w) as ink on paper, (h, w, 3): darker where the bristles pressed harder."""
    cover = np.asarray(coverage)[..., None]
    color = ramp(PAINT, 0.15 + 0.85 * np.asarray(pressure) / dark)
    return np.array(PAPER) * (1.0 - 0.92 * cover) + 0.92 * cover * color


class Show(NamedTuple):
    """A fit to be drawn. case: with true stroke, exact maps, origin. curves: the stroke at every
    step. errors: of its path [mm]. redraw: stroke to exact maps. side: of the maps [mm]."""

    name: str
    case: object
    curves: list
    errors: list
    redraw: Callable
    side: float


def panels(show: Show, steps, first=True):
    """Pictures of a fit at `steps`, after that of the maps it reads: (title, arguments of `draw`)
    in one window."""
    case, side = show.case, show.side
    true = np.asarray(case.true.position)
    cover, corner = np.asarray(case.exact.coverage), np.asarray(case.origin)
    dark = max(1e-3, float(np.quantile(np.asarray(case.exact.pressure)[cover > 0], 0.97)))
    rows, columns = np.nonzero(cover)
    touched = np.stack([columns, rows], 1) * side / len(cover) + corner
    points = np.concatenate([touched, true, np.asarray(show.curves[0].position)])
    low, high = points.min(0) - 1.5, points.max(0) + 1.5
    view = (*low, *high)

    found = []
    if first:
        image = ink(case.exact.pressure, case.exact.coverage, dark)
        found = [("the maps it reads", (image, corner, side, view))]
    for step in steps:
        curve, off = show.curves[step], show.errors[step]
        maps = show.redraw(curve)
        name = "start" if step == 0 else f"step {step}"
        name = f"{name}: {off:.2f} mm off" if off >= 0.1 else f"{name}: {1e3 * off:.0f} µm off"
        image = ink(maps.pressure, maps.coverage, dark)
        path, pressure = np.asarray(curve.position), np.asarray(curve.pressure)
        found.append((name, (image, corner, side, view, path, pressure, true)))
    return found


def draw(axis, image, corner, side: float, view, path=None, pressure=None, true=None):
    """One picture: maps, the true path as a thin line and the fitted one as wide as it presses."""
    axis.imshow(
        image,
        extent=(corner[0], corner[0] + side, corner[1] + side, corner[1]),
        interpolation="antialiased",
    )
    if true is not None:
        axis.plot(*true.T, color=PAPER, lw=2.4, zorder=2, alpha=0.75)
        axis.plot(*true.T, color=TRUTH, lw=1.1, ls=(0, (3.2, 2.0)), zorder=4)
    if path is not None:
        pairs = np.stack([path[:-1], path[1:]], axis=1)
        axis.add_collection(
            LineCollection(
                pairs,
                color=HAND,
                lw=0.7 + 5.0 * pressure[1:],
                zorder=3,
                alpha=0.9,
                capstyle="round",
            )  # fmt: skip
        )
        axis.plot(*path[0], "o", ms=4.5, color=HAND, zorder=5, mec=PAPER, mew=0.7)
    axis.set(xlim=view[::2], ylim=view[3::-2], xticks=[], yticks=[])
    axis.grid(False)
    axis.set_facecolor(PAPER)
    for spine in axis.spines.values():
        spine.set_visible(False)


def strip(shows: list[Show], steps, path: Path, dots: int = 100):
    """Rows of pictures, one a stroke: the maps it reads, and the fit at `steps`."""
    rows = [(show.name, panels(show, steps)) for show in shows]
    columns = 1 + len(steps)
    views = np.array([row[0][1][3] for _, row in rows])
    tall = 2.75 * (views[:, 3] - views[:, 1]) / (views[:, 2] - views[:, 0]) + 0.3
    figure, axes = plt.subplots(
        len(rows), columns, figsize=(2.75 * columns, tall.sum()), height_ratios=tall, squeeze=False
    )
    figure.set_facecolor(PAPER)
    for line, (name, row) in zip(axes, rows, strict=True):
        for axis, (title, arguments) in zip(line, row, strict=True):
            draw(axis, *arguments)
            axis.set_title(title, fontsize=11, color=INK, family="serif", weight="normal", y=0.98)
        line[0].text(
            -0.03, 0.5, name, transform=line[0].transAxes, rotation=90, va="center", ha="right",
            fontsize=12, family="serif", style="italic", color=INK,
        )  # fmt: skip
    figure.set_dpi(dots)
    figure.canvas.draw()
    pixels = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy())
    plt.close(figure)
    partial = path.with_name(path.name + ".partial")
    pixels.quantize(256, dither=Image.Dither.NONE).save(partial, "PNG", optimize=True)
    partial.replace(path)


def film(show: Show, total: int, path: Path, size: float = 4.2, dots: int = 84):
    """An animated GIF of a fit of `total` steps, slow at first; the last picture stays."""
    frames = []
    steps = sorted({int(round(total * (k / 44) ** 1.8)) for k in range(45)})
    for title, arguments in panels(show, steps, first=False):
        low, high = np.array(arguments[3]).reshape(2, 2)
        wide, tall = size * (high - low) / np.max(high - low)
        figure = plt.figure(figsize=(wide, tall), layout="none")
        figure.set_facecolor(PAPER)
        axis = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        draw(axis, *arguments)
        axis.text(0.03, 0.03, title, transform=axis.transAxes, fontsize=13, color=INK,
                  family="serif")  # fmt: skip
        figure.set_dpi(dots)
        figure.canvas.draw()
        frames.append(Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()))
        plt.close(figure)
    # One palette for all, so that the paper does not flicker.
    palette = frames[-1].quantize(64)
    frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    partial = path.with_name(path.name + ".partial")
    times = [700] + [90] * (len(frames) - 2) + [2600]
    frames[0].save(partial, "GIF", save_all=True, append_images=frames[1:], duration=times, loop=0,
                   optimize=True)  # fmt: skip
    partial.replace(path)


def chart(rows, opening: int, levels, bar: float, path: Path):
    """Path error [mm] of every stroke against step: the opening, the levels by their pixel."""
    curves = {row["stroke"]: row["path_by_step"] for row in rows}
    ends = np.cumsum([opening, *(level.steps for level in levels)])
    names = ["opening", *(f"{level.pixel:g} mm" for level in levels)]
    figure, axis = plt.subplots(figsize=(7.6, 4.3))
    start = 0
    for index, (end, name) in enumerate(zip(ends, names, strict=True)):
        if index % 2:
            axis.axvspan(start, end, color="#f4efe6", lw=0, zorder=0)
        axis.text(0.5 * (start + end), 1.01, name, ha="center", va="bottom",
                  fontsize=8, color=INK, transform=axis.get_xaxis_transform())  # fmt: skip
        start = end
    for index, (name, curve) in enumerate(curves.items()):
        axis.plot(curve, lw=1.6, color=COLORS[index % len(COLORS)], label=name)
    axis.axhline(bar, color=INK, lw=1.0, ls=(0, (4, 3)))
    axis.text(3, bar * 0.94, "half a pixel of the maps", va="top", fontsize=9)
    axis.set(yscale="log", xlabel="step", ylabel="path error, rms [mm]", xlim=(0, start))
    axis.legend(fontsize=8, ncols=2, loc="upper right")
    save_figure(figure, path)


def report(rows, pixel: float, title: str):
    """Prints the table of all strokes."""
    print_table(
        title,
        ["stroke", "start [mm]", "opened", "first", "end [mm]", "end [pixels]", "largest [mm]",
         "firm [mm]", "pressure from", "to, rms", "seconds", "gaps"],
        [
            [
                r["stroke"],
                f"{r['start']['path']:.2f}",
                f"{r['opened']['path']:.2f}",
                f"{r['first']['path']:.4f}",
                f"{r['end']['path']:.4f}",
                f"{r['end']['path'] / pixel:.2f}",
                f"{r['end']['most']:.3f}",
                f"{r['end']['firm']:.4f}",
                f"{r['start']['press']:.3f}",
                f"{r['end']['press']:.4f}",
                f"{r['seconds']:.0f}",
                r["holes"],
            ]
            for r in rows
        ],
    )  # fmt: skip
