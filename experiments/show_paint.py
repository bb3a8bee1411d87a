"""First pictures of the paint simulator: strokes over bare canvas, over each other, and corners.

python -m experiments.show_paint            # about 3 minutes
python -m experiments.show_paint --quick    # one stroke
"""

import dataclasses
import os
import time
from pathlib import Path
from typing import Annotated

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.progress import track

from experiments.common import console, print_table, results_folder, write_run
from jaxbrush.brush import BrushConfig, make_brush, rollout
from jaxbrush.canvas import flatten
from jaxbrush.paint import (
    PaintConfig,
    empty_canvas,
    height,
    load_brush,
    make_params,
    paint_stroke,
    volume,
    weave,
)
from jaxbrush.render import picture, shade
from jaxbrush.stylus import make_stroke, resample

PALETTE = {
    "white": (0.92, 0.90, 0.84), "orange": (0.80, 0.16, 0.02), "green": (0.02, 0.25, 0.10),
    "black": (0.02, 0.02, 0.03),
}  # fmt: skip
"""Pigments, linear RGB."""
STAMPS, SPEED = 320, 60.0
"""Stamps a stroke is padded to; speed of the hand [mm/s]."""
BRISTLES = 260
SHAPE = (160, 288)
"""Canvas [pixels]."""

# Color, load, pressure, corners of the path [mm].
STROKES = (
    ("green", 0.8, 0.5, ((4, 4), (33, 4))),
    ("green", 0.8, 0.5, ((8, 9), (8, 19))),
    ("black", 0.8, 0.5, ((16, 9), (16, 19))),
    ("orange", 0.8, 0.5, ((3, 14), (33, 14))),
    ("white", 0.8, 0.4, ((26, 18), (30, 9), (34, 17))),
)


@dataclasses.dataclass(frozen=True)
class Config:
    """Pictures of painted strokes."""

    out: Annotated[Path | None, tyro.conf.arg(help="Folder for the pictures.")] = None
    """Folder for the pictures [default: results/show_paint]."""
    quick: bool = False
    """The first stroke only."""
    scale: int = 4
    """Enlargement of the picture."""


def hand(corners, pressure: float, pixel: float, depth: float = 5.0):
    """A stroke through rounded corners, stamps a pixel of the handle's way apart, pressed and
    lifted at its ends."""
    corners = np.asarray(corners, float)
    u = np.linspace(0.0, 1.0, 400)
    at = np.linspace(0.0, 1.0, len(corners))
    path = np.stack([np.interp(u, at, corners[:, k]) for k in (0, 1)], 1)
    soft = np.hanning(41) / np.hanning(41).sum()
    path = np.pad(path, ((20, 20), (0, 0)), mode="edge")
    path = np.stack([np.convolve(path[:, k], soft, "valid") for k in (0, 1)], 1)
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    share = way / way[-1]
    press = pressure * np.clip(np.minimum(share / 0.12, (1.0 - share) / 0.15), 0.0, 1.0)
    heading = np.arctan2(*(path[-1] - path[0])[::-1])
    stroke = make_stroke(path, way / SPEED, press, altitude=np.radians(50.0), azimuth=heading)
    return resample(stroke, STAMPS, pixel, np.inf, depth)


def main(options: Config) -> None:
    folder = results_folder("show_paint", options.out)
    config, params, brush_config = PaintConfig(), make_params(), BrushConfig()
    brush = make_brush(jax.random.key(0), brush_config, "flat", BRISTLES, width=4.5, thickness=1.4)
    move, lay = jax.jit(rollout), jax.jit(paint_stroke)
    tooth = jnp.asarray(weave(SHAPE, config.pixel), float)
    canvas = empty_canvas(config, SHAPE)
    names = list(PALETTE)
    rows, strokes = [], STROKES[:1] if options.quick else STROKES
    for color, load, pressure, corners in track(strokes, "strokes", console=console):
        mix = jnp.asarray([float(n == color) for n in names])
        stroke = hand(corners, pressure, config.pixel)
        bristles = move(brush_config, brush, stroke)
        full = load_brush(config, params, BRISTLES, load, mix)
        before = float(volume(config, canvas).sum() + full.tip.sum() + full.reservoir.sum())
        start = time.perf_counter()
        canvas, left, report = jax.block_until_ready(
            lay(config, params, canvas, full, bristles, tooth)
        )
        seconds = time.perf_counter() - start
        kept = float(left.tip.sum() + left.reservoir.sum())
        now = float(volume(config, canvas).sum()) + kept
        rows.append(
            [color, f"{float(full.tip.sum() + full.reservoir.sum()) - kept:.2f}",
             f"{(now - before) / before:.1e}", f"{float(height(config, canvas).max()):.2f}",
             f"{float(report.fullest.max()):.4f}", f"{1e3 * seconds / STAMPS:.0f}"]
        )  # fmt: skip
    seen = flatten(canvas, config.layer, jnp.asarray(list(PALETTE.values())), mixing="subtractive")
    image = np.asarray(picture(shade(seen, config.pixel, weave=tooth)))
    size = (SHAPE[1] * options.scale, SHAPE[0] * options.scale)
    image = cv2.resize(image[..., ::-1], size, interpolation=cv2.INTER_CUBIC)
    # Written under another name first, so that no half picture is left behind.
    cv2.imwrite(str(folder / "partial.png"), image)
    os.replace(folder / "partial.png", folder / "paint.png")
    columns = ["stroke", "laid [mm³]", "volume drift", "highest [mm]", "fullest cell", "ms a stamp"]
    write_run(folder, options, {"strokes": [dict(zip(columns, r, strict=True)) for r in rows]})
    print_table("Strokes (the first includes compilation)", columns, rows)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
