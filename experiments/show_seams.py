"""Seams between patches, with every way to avoid them (paper Figure 9): pictures, size, time.

python -m experiments.show_seams
python -m experiments.show_seams --instance HEIGHT.npz COLOR.npz    # beside networks with moments
"""

import dataclasses
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import tyro
from rich.progress import track

from experiments import engines, paint_scenes, paint_session
from experiments.common import console, helped, print_table, results_folder, save_figure, write_run
from jaxbrush import painter, patches, seams, stages
from jaxbrush.canvas import blank
from jaxbrush.recordings import BrushEvent

WAYS = (("patch", "cut"), ("patch", "feather"), ("patch", "poisson"), ("stroke", "cut"))
"""Moments of the normalisation, and blend."""
NAMES = {
    ("patch", "cut"): "side by side", ("patch", "feather"): "linear feather",
    ("patch", "poisson"): "Poisson blend", ("stroke", "cut"): "one stroke's moments",
}  # fmt: skip
LOCAL = "networks without moments"
BAR = 1.0 / 255.0
SHAPE = (192, 320)


@dataclasses.dataclass(frozen=True)
class Config:
    """Paints the same strokes with every blend."""

    weights: tuple[Path, Path] = engines.SHIPPED
    """Height and color network, painted side by side."""
    instance: tuple[Path, Path] | None = None
    """Two with instance normalisation, as the paper's, painted with every blend."""
    out: Path | None = None
    """Folder for picture and numbers [default: results/show_seams]."""
    quick: bool = False
    """One stroke in place of four."""


def deeds() -> list[engines.Deed]:
    """Long strokes over each other, across many patches."""
    brush, paint, say = engines.brush_of(BrushEvent({"width": 3.6, "length": 16.8, "depth": 4.2}))
    ways = (
        ((3.0, 5.0), (14.0, 9.0), (26.0, 5.0), (37.0, 9.0)),
        ((3.0, 18.0), (15.0, 13.0), (26.0, 19.0), (37.0, 15.0)),
        ((8.0, 21.0), (14.0, 12.0), (21.0, 3.0)),
        ((36.0, 3.5), (24.0, 12.0), (5.0, 12.5)),
    )
    colors = ((0.02, 0.06, 0.30), (0.80, 0.16, 0.02), (0.85, 0.55, 0.04), (0.92, 0.90, 0.84))
    return [
        engines.Deed(paint_scenes.drawn(way, 0.45), brush, paint, color, 0.9, say["bristles"])
        for way, color in zip(ways, colors, strict=True)
    ]


def seam_of(options: stages.PainterConfig, watched: dict, before, box) -> np.ndarray:
    """Seams [image scale] of a stroke, where there are any, from what `paint_stroke` watched."""
    drawn, painted = watched["maps"], watched["networks"]
    layout = patches.layout(options.patches, box, drawn.mask[..., 0], len(painted))
    h, w = before.height.shape
    merged = patches.place(stages.blend(options, painted, layout), layout, jnp.zeros((h, w, 4)))
    tiles = patches.cut_tiles(options.patches, box, drawn.mask[..., 0], layout)
    mask = patches.place(tiles, layout, jnp.zeros((h, w)))
    found = np.asarray(_seam(options.patches, painted, layout, merged, mask))
    return found[found > 0.0]


_seam = jax.jit(seams.seam)


def paint_all(how: painter.PainterConfig, nets: painter.Nets, strokes):
    """(canvas, seams where there are any [image scale], milliseconds of each stroke)."""
    found, took = [np.zeros(1)], []
    for timed in (False, True):
        canvas = blank(SHAPE)
        for deed in strokes:
            watched = {}
            start = time.perf_counter()
            after = painter.paint_stroke(
                how, nets, canvas, deed.brush, np.asarray(deed.color, np.float32), deed.stroke,
                watch=lambda stage, value, to=watched: to.update({stage: value}),
            )  # fmt: skip
            jax.block_until_ready(after)
            if timed:
                took.append(1e3 * (time.perf_counter() - start))
            else:
                box = painter.place(how, SHAPE, watched["brush"][1])
                found.append(seam_of(how, watched, canvas, box))
            canvas = after
    return canvas, np.concatenate(found), took


def main(options: Config) -> None:
    try:
        jobs = {LOCAL: (painter.load_nets(*options.weights), ("stroke", "cut"))}
        if options.instance:
            others = painter.load_nets(*options.instance)
            jobs = {NAMES[way]: (others, way) for way in WAYS} | jobs
    except (ValueError, OSError) as error:
        raise SystemExit(f"{error}") from error
    folder = results_folder("show_seams", options.out)
    strokes = deeds()[: 1 if options.quick else None]
    results, pictures = {}, {}
    for name, (nets, (moments, blend)) in track(jobs.items(), "blends", console=console):
        how = painter.PainterConfig(moments=moments, blend=blend, sides=())
        canvas, every, took = paint_all(how, nets, strokes)
        results[name] = {
            "largest": float(every.max()), "p99": float(np.percentile(every, 99.0)),
            "milliseconds": float(np.median(took)),
        }  # fmt: skip
        pictures[name] = paint_session.lit(canvas)
    rows = -(-len(pictures) // 2)
    figure, axes = plt.subplots(
        rows, 2, figsize=(13.0, 4.3 * rows), layout="constrained", squeeze=False
    )
    for axis in axes.ravel()[len(pictures) :]:
        axis.set_axis_off()
    for axis, (name, picture) in zip(axes.ravel(), pictures.items(), strict=False):
        row = results[name]
        axis.imshow(picture)
        axis.set(xticks=[], yticks=[])
        axis.set_title(
            f"{name}: seams up to {255 * row['largest']:.1f}/255, {row['milliseconds']:.0f} ms",
            loc="left",
        )
        axis.grid(False)
    save_figure(figure, folder / "seams.png", dpi=110)
    write_run(folder, options, results)
    rows = [
        [name, f"{255 * r['largest']:.2f}", f"{255 * r['p99']:.2f}", f"{r['milliseconds']:.0f}",
         "yes" if r["largest"] <= BAR else "no"]
        for name, r in results.items()
    ]  # fmt: skip
    print_table(
        "Seams in 255ths of image scale", ["blend", "largest", "99 %", "ms/stroke", "<= 1"], rows
    )
    console.print(f"picture: {folder / 'seams.png'}")


if __name__ == "__main__":
    main(tyro.cli(Config, description=helped(__doc__)))
