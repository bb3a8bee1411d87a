"""Pictures of trajectory maps: eight strokes in five maps, and what a count of sweeps gets wrong.

python -m experiments.show_maps            # about a minute
python -m experiments.show_maps --quick    # three strokes
"""

import dataclasses
import functools
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import tyro
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from PIL import Image
from rich.progress import track as progress

from experiments.common import (
    FAINT,
    INK,
    console,
    helped,
    print_table,
    results_folder,
    timed,
    write_run,
)
from experiments.map_cases import SIDE, STROKES, draw, roll, square_grid, stroke_of
from jaxbrush.brush import BrushConfig, make_brush
from jaxbrush.raster import WIDTH

COLUMNS = ("pressure", "sweeps", "color", "time", "coverage")
PAPER = (0.984, 0.974, 0.950)
BLUE, YELLOW = (0.015, 0.085, 0.36), (0.86, 0.50, 0.02)
"""What the two halves of the brush are loaded with, linear RGB."""


@dataclasses.dataclass(frozen=True)
class Config:
    """Pictures of trajectory maps."""

    out: Annotated[Path | None, tyro.conf.arg(help="Folder for the pictures.")] = None
    """Folder for the pictures [default: results/show_maps]."""
    quick: bool = False
    """Three strokes: the same code in under a minute."""
    strokes: tuple[str, ...] = STROKES
    """Rows of the sheet."""
    bristles: int = 256
    """Bristles of the flat brush."""
    stamps: int = 400
    """Stamps of a stroke."""
    edge: float | None = None
    """Edge width of soft maps [mm]; exact maps without."""
    zoom: int = 2
    """Pixels of the sheet along a pixel of a map."""
    seed: int = 7
    """Seed of the brush's irregularity."""


def colors_of(params):
    """(b, 3) linear RGB: one half of the ferrule blue, the other yellow."""
    left = params.root[:1].T < 0.0
    return jnp.where(left, jnp.asarray([BLUE]), jnp.asarray([YELLOW])).astype(params.root.dtype)


def _part(name: str, low: float, high: float):
    """A part of a colormap, so that the least value can be told from the paper."""
    return LinearSegmentedColormap.from_list(name, plt.get_cmap(name)(np.linspace(low, high, 64)))


@functools.cache
def scales():
    """Colormap and value at its end for each map; `sweeps` by its square root."""
    weight = _part("magma_r", 0.1, 0.97)
    return {
        "pressure": (weight, 1.5),
        "sweeps": (_part("YlGnBu", 0.25, 1.0), 36.0),
        "time": (_part("viridis", 0.0, 1.0), 1.0),
        "coverage": (LinearSegmentedColormap.from_list("ink", [PAPER, INK]), 1.0),
    }


def _encoded(linear):
    """sRGB of linear RGB."""
    linear = np.clip(linear, 0.0, 1.0)
    low, high = 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, low, high)


def picture(maps, name: str):
    """(h, w, 3) sRGB of one map, paper where nothing touched."""
    cover = np.asarray(maps.coverage)
    solid = np.maximum(cover, 1e-6)
    if name == "color":
        drawn = _encoded(np.asarray(maps.color) / solid[..., None])
    else:
        colormap, most = scales()[name]
        value = np.asarray(getattr(maps, name), float)
        if name in ("pressure", "time"):
            value = value / solid
        value = np.clip(value / most, 0.0, 1.0)
        drawn = colormap(np.sqrt(value) if name == "sweeps" else value)[..., :3]
    share = (cover > 0.0) if name == "coverage" else np.clip(cover, 0.0, 1.0)
    return PAPER + (drawn - np.array(PAPER)) * share[..., None]


def bounds(cover, margin: int = 6):
    """Rows (first, last + 1) that hold anything, with a margin; at least 40."""
    rows = np.flatnonzero(np.asarray(cover).max(1) > 0.0)
    first, last = (rows[0], rows[-1] + 1) if len(rows) else (0, 1)
    extra = max(margin, (40 - (last - first) + 1) // 2)
    return max(first - extra, 0), min(last + extra, len(cover))


class Page:
    """A picture laid out in pixels from the top left corner."""

    def __init__(self, width: int, height: int, unit: float):
        self.size, self.unit = (width, height), unit
        self.figure = plt.figure(figsize=(width / 100, height / 100), dpi=100, layout="none")
        self.figure.set_facecolor(PAPER)

    def image(self, x: int, y: int, pixels):
        self.figure.figimage(pixels, x, self.size[1] - y - pixels.shape[0], origin="upper")

    def text(self, x, y, text, size=11.0, **rest):
        """`size` in units of the page, which grow with the zoom."""
        rest = {"color": INK, "family": "serif", "va": "center", **rest}
        points = size * self.unit * 0.72
        self.figure.text(x / self.size[0], 1.0 - y / self.size[1], text, fontsize=points, **rest)

    def save(self, path: Path, colors: int | None):
        self.figure.canvas.draw()
        pixels = Image.fromarray(np.asarray(self.figure.canvas.buffer_rgba())[..., :3].copy())
        plt.close(self.figure)
        if colors:
            pixels = pixels.quantize(colors, dither=Image.Dither.NONE)
        partial = path.with_name(path.name + ".partial")
        pixels.save(partial, "PNG", optimize=True)
        partial.replace(path)


def _enlarged(pixels, zoom: int):
    return np.repeat(np.repeat(pixels, zoom, 0), zoom, 1)


def _key(page: Page, name: str, x: int, y: int, zoom: int):
    """The scale of a column, under its heading."""
    long, tall = int(96 * zoom), int(4 * zoom)
    if name == "color":
        for k, (color, text) in enumerate(((BLUE, "one half"), (YELLOW, "other half"))):
            left = x + int(k * 84 * zoom)
            swatch = np.broadcast_to(_encoded(np.array(color)), (tall, int(12 * zoom), 3))
            page.image(left, y - tall // 2, swatch)
            page.text(left + 16 * zoom, y, text, 11.5)
        return
    if name == "coverage":
        page.text(x, y, "touched or not", 11.5)
        return
    colormap, most = scales()[name]
    bar = np.broadcast_to(colormap(np.linspace(0, 1, long))[None, :, :3], (tall, long, 3))
    page.image(x, y - tall // 2, bar)
    low, high = {
        "pressure": ("0", f"{0.2 * most:g} mN"),
        "sweeps": ("1", f"{most:.0f} times"),
        "time": ("start", "end"),
    }[name]
    page.text(x, y + 9.5 * zoom, low, 11.5)
    page.text(x + long, y + 9.5 * zoom, high, 11.5, ha="right")


def sheet(drawn: dict, zoom: int, path: Path):
    """Strokes down, maps across."""
    gap, left, top, bottom = 5 * zoom, 34 * zoom, 56 * zoom, 14 * zoom
    rows = {name: bounds(maps.coverage) for name, maps in drawn.items()}
    wide = SIDE * zoom
    height = top + bottom + sum((b - a) * zoom + gap for a, b in rows.values())
    page = Page(left + len(COLUMNS) * (wide + gap), height, zoom)
    for c, name in enumerate(COLUMNS):
        x = left + c * (wide + gap)
        page.text(x, 14 * zoom, name, 21.0, style="italic")
        _key(page, name, x, 31 * zoom, zoom)
    y = top
    for stroke, (first, last) in rows.items():
        tall = (last - first) * zoom
        page.text(15 * zoom, y + tall / 2, stroke, 18.0, rotation=90, ha="center")
        for c, name in enumerate(COLUMNS):
            cell = picture(drawn[stroke], name)[first:last]
            page.image(left + c * (wide + gap), y, _enlarged(cell, zoom))
        y += tall + gap
    x = left + (len(COLUMNS) - 1) * (wide + gap)
    bar = np.broadcast_to(to_rgb(INK), (max(zoom // 2, 1), 50 * zoom, 3))
    page.image(x, height - 2 * bottom // 3, bar)
    page.text(x + 54 * zoom, height - 2 * bottom // 3, "5 mm", 12.0)
    page.save(path, 256)


def comparison(light, heavy, zoom: int, path: Path) -> dict:
    """The paper's Figure 3: a light and a heavy stroke by count and by pressure, each map scaled
    by what the heavy stroke has.

    Returns:
      {"sweeps", "pressure": mean of the light stroke over that of the heavy one}, where touched.
    """

    def mean(maps, name):
        return float(np.sum(getattr(maps, name)) / max(float(np.sum(maps.coverage)), 1e-6))

    shares = {name: mean(light, name) / mean(heavy, name) for name in ("sweeps", "pressure")}
    rows = [bounds(maps.coverage) for maps in (light, heavy)]
    gap, left, top = 8 * zoom, 26 * zoom, 34 * zoom
    wide = SIDE * zoom
    page = Page(left + 2 * (wide + gap), top + sum((b - a) * zoom + gap for a, b in rows), zoom)
    colormap = scales()["pressure"][0]
    y = top
    for maps, (first, last), name in zip((light, heavy), rows, ("light", "heavy"), strict=True):
        tall = (last - first) * zoom
        page.text(12 * zoom, y + tall / 2, name, 15.0, rotation=90, ha="center")
        for c, kind in enumerate(("sweeps", "pressure")):
            top_value = 1.8 * mean(heavy, kind)
            value = np.clip(np.asarray(getattr(maps, kind)) / top_value, 0.0, 1.0)
            cover = (np.asarray(maps.coverage) > 0.0)[..., None]
            cell = np.where(cover, colormap(value)[..., :3], PAPER)[first:last]
            page.image(left + c * (wide + gap), y, _enlarged(cell, zoom))
        y += tall + gap
    for c, (kind, title) in enumerate((("sweeps", "sweep count"), ("pressure", "pressure"))):
        x = left + c * (wide + gap)
        page.text(x, 11 * zoom, title, 16.0, style="italic")
        page.text(x, 25 * zoom, f"the light stroke has {100 * shares[kind]:.0f} % of the heavy one",
                  9.5, color=FAINT)  # fmt: skip
    page.save(path, 64)
    return shares


def gaps(coverage) -> dict:
    """What an eye would trip over: pixels untouched inside the stroke (all four neighbours two
    pixels away are touched), and touched pixels without a touched neighbour."""
    cover = np.pad(np.asarray(coverage) > 0.0, 2)
    inner = cover[2:-2, 2:-2]

    def around(step):
        shifts = ((step, 0), (-step, 0), (0, step), (0, -step))
        return [np.roll(cover, shift, (0, 1))[2:-2, 2:-2] for shift in shifts]

    hole = ~inner & np.logical_and.reduce(around(2))
    lone = inner & ~np.logical_or.reduce(around(1))
    return {"touched": int(inner.sum()), "holes": int(hole.sum()), "lone": int(lone.sum())}


def main(options: Config) -> None:
    names = options.strokes
    if options.quick:
        names = ("light", "heavy", "crossing")
        options = dataclasses.replace(options, strokes=names)
    folder = results_folder("show_maps", options.out)
    config = BrushConfig()
    params = make_brush(jax.random.key(options.seed), config, "flat", options.bristles)
    color = colors_of(params)
    drawn, found = {}, {}
    # The comparison needs these two, whatever is on the sheet.
    needed = dict.fromkeys((*names, "light", "heavy"))
    for name in progress(list(needed), description="strokes", console=console, transient=True):
        track = roll(config, params, stroke_of(name, options.stamps))
        grid = square_grid(track, WIDTH)
        drawn[name], timing = timed(draw, grid, track, color, WIDTH, options.edge, repeats=5)
        found[name] = {"time": timing, **gaps(drawn[name].coverage)}
        for kind in ("pressure", "sweeps"):
            value = np.asarray(getattr(drawn[name], kind))
            found[name][kind] = float(value.sum() / max(found[name]["touched"], 1))
    sheet({name: drawn[name] for name in names}, options.zoom, folder / "maps.png")
    shares = comparison(
        drawn["light"], drawn["heavy"], options.zoom, folder / "pressure_sweeps.png"
    )
    write_run(folder, options, {"strokes": found, "light_over_heavy": shares})
    rows = [
        [name, f["touched"], f"{f['pressure']:.3f}", f"{f['sweeps']:.1f}", f["holes"], f["lone"],
         f"{f['time'].low * 1e3:.1f}"]
        for name, f in found.items()
    ]  # fmt: skip
    print_table(
        f"{options.bristles} bristles, {options.stamps} stamps; pictures in {folder}",
        ["stroke", "pixels", "mean pressure [0.2 mN]", "mean sweeps", "holes", "lone pixels",
         "maps [ms]"],
        rows,
    )  # fmt: skip
    console.print(
        f"The light stroke presses {100 * shares['pressure']:.1f} % as hard as the heavy one; its "
        f"sweep count is {100 * shares['sweeps']:.1f} % of the heavy one's."
    )


if __name__ == "__main__":
    main(tyro.cli(Config, description=helped(__doc__)))
