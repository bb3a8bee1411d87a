"""The paint catalogue: strokes by brush, pressure and load; layers; a small painting.

python -m experiments.show_paint                    # four sheets
python -m experiments.show_paint --only sea         # one of them
python -m experiments.show_paint --quick            # four strokes
"""

import dataclasses
import os
import time
from pathlib import Path
from typing import Literal

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.progress import track

from experiments.common import console, helped, print_table, results_folder, write_run
from experiments.paint_scenes import BRISTLES, NAMES, PALETTE, SCENES, brush_of, hand, relief_of
from jaxbrush.brush import BrushConfig, rollout
from jaxbrush.canvas import flatten
from jaxbrush.paint import (
    PaintConfig,
    empty_canvas,
    height,
    load_brush,
    paint_stroke,
    presets,
    weave,
)
from jaxbrush.render import picture, shade

SHAPE = (264, 576)
"""Canvas of every sheet [pixels]: one compilation; cut to its own size at the end."""


@dataclasses.dataclass(frozen=True)
class Config:
    """Pictures of painted strokes."""

    out: Path | None = None
    """Folder for the pictures [default: results/show_paint]."""
    only: Literal["strokes", "layers", "dry", "sea"] | None = None
    """One sheet of the four."""
    quick: bool = False
    """Four strokes of the first sheet."""
    scale: int = 3
    """Enlargement of the pictures."""


def held(brush) -> float:
    """Volume of the paint in a brush [mm^3]; summed in float64, as a budget should be."""
    return float(sum(np.asarray(part, np.float64).sum() for part in (brush.tip, brush.reservoir)))


def total(config: PaintConfig, canvas, brush) -> float:
    """Volume of the paint on canvas and brush [mm^3]."""
    return config.cell * float(np.asarray(canvas).sum(dtype=np.float64)) + held(brush)


def cloth(config: PaintConfig, name: str):
    """Weave (y, x) of a sheet [mm]."""
    return weave(SHAPE, config.pixel, relief_of(name))


def paint(config: PaintConfig, spacing: float, touches, name: str):
    """Paints the strokes of a sheet one after the other, stamps `spacing` apart [mm].

    Returns:
      (canvas, list of numbers of each stroke).
    """
    brush_config = BrushConfig()
    move, lay = jax.jit(rollout), jax.jit(paint_stroke)
    tooth = cloth(config, name)
    canvas, rows = empty_canvas(config, SHAPE), []
    for touch in track(touches, name, console=console):
        brush, params, depth = brush_of(touch.brush, brush_config)
        stroke = hand(touch.corners, touch.pressure, spacing, depth, touch.fall)
        bristles = move(brush_config, brush, stroke)
        mix = jnp.asarray([touch.color.get(name, 0.0) for name in NAMES])
        full = load_brush(config, params, BRISTLES, touch.load, mix)
        before = total(config, canvas, full)
        start = time.perf_counter()
        canvas, left, report = jax.block_until_ready(
            lay(config, params, canvas, full, bristles, tooth)
        )
        seconds = time.perf_counter() - start
        now = total(config, canvas, left)
        rows.append(
            {
                "brush": touch.brush,
                "laid": held(full) - held(left),
                "drift": (now - before) / max(before, 1e-9),
                "highest": float(height(config, canvas).max()),
                "ms": 1e3 * seconds / int(stroke.valid.sum()),
            }
        )
    return canvas, rows


def render(config: PaintConfig, canvas, tooth, shape, scale: int) -> np.ndarray:
    """The lit canvas, cut to `shape` pixels, 8-bit BGR."""
    palette = jnp.asarray(list(PALETTE.values()))
    seen = flatten(canvas, config.layer, palette, mixing="subtractive")
    image = np.asarray(picture(shade(seen, config.pixel, weave=tooth)))
    image = image[: shape[0], : shape[1], ::-1]
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)


def main(options: Config) -> None:
    folder = results_folder("show_paint", options.out)
    config, _, spacing = presets.offline()
    config = dataclasses.replace(config, pigments=len(PALETTE))
    table, numbers = [], {}
    for name, (shape, touches) in SCENES.items():
        if options.only not in (None, name) or (options.quick and name != "strokes"):
            continue
        touches = touches()[: 4 if options.quick else None]
        canvas, rows = paint(config, spacing, touches, name)
        # Written under another name first, so that no half picture is left behind.
        image = render(config, canvas, cloth(config, name), shape, options.scale)
        cv2.imwrite(str(folder / "partial.png"), image)
        os.replace(folder / "partial.png", folder / f"{name}.png")
        numbers[name] = rows
        column = lambda key, rows=rows: [row[key] for row in rows]  # noqa: E731
        table.append(
            [name, len(rows), f"{sum(column('laid')):.0f}",
             f"{max(map(abs, column('drift'))):.1e}", f"{column('highest')[-1]:.2f}",
             f"{np.median(column('ms')):.0f}"]
        )  # fmt: skip
    write_run(folder, options, numbers)
    columns = ["sheet", "strokes", "laid [mm³]", "largest drift", "highest [mm]", "ms a stamp"]
    print_table(f"Painted, pictures in {folder}", columns, table)


if __name__ == "__main__":
    main(tyro.cli(Config, description=helped(__doc__)))
