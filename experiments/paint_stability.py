"""Where the paint simulator holds: interval of the stamps against rounds and solver."""

import dataclasses
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from experiments.common import INK, save_figure
from experiments.paint_cases import (
    BRISTLES,
    Result,
    Setting,
    beads,
    errors,
    lay,
    thinned,
    touched,
    track_of,
)
from jaxbrush.paint import PaintConfig

SPACINGS = (0.0625, 0.125, 0.25, 0.5, 1.0)  # [mm]
ROWS = (
    ("1 + 2 rounds", {"viscous": 1, "pressure": 2}),
    ("3 + 5", {"viscous": 3, "pressure": 5}),
    ("9 + 20", {}),
    ("18 + 40", {"viscous": 18, "pressure": 40}),
    ("9 + 20, line PCG", {"solver": "zline_pcg"}),
    ("9 + 20, Jacobi PCG", {"solver": "jacobi_pcg"}),
    ("9 + 20, fixed point", {"solver": "fixed_point"}),
)
SHOWN = (30.0, 300.0)
"""Errors [µm] between which the map's colors change."""


def judge(found: Result, true: Result, spacing: float, seen) -> dict:
    """A cell of the map. seen: (how many times its surroundings, [µm]) from which beads show."""
    line, tall = beads(found, spacing) if spacing >= 0.25 else (0.0, 0.0)
    height, color = errors(found, true)
    sound = np.all(np.isfinite(found.amounts)) and abs(found.drift) < 1e-6
    sound = sound and found.fullest < 1.0 + 1e-3
    return {
        "height": height, "color": color, "laid": found.laid / true.laid - 1.0,
        "sound": bool(sound), "fullest": found.fullest, "drift": found.drift,
        "beads": bool(line > seen[0] and tall > seen[1]), "tall": tall,
    }  # fmt: skip


def stability(base: PaintConfig, true: Result, length: float, quick: bool, seen, progress) -> list:
    """Rows of cells, as ROWS and SPACINGS; all tracks are of one shape, so a row compiles once."""
    rows, spacings = (ROWS[:1], SPACINGS[1:3]) if quick else (ROWS, SPACINGS)
    full = thinned(track_of(length), spacings[0], BRISTLES).time.shape[0]
    task = progress.add_task("stability", total=len(rows) * len(spacings))
    found = []
    for name, changes in rows:
        config = dataclasses.replace(base, **changes)
        cells = []
        for spacing in spacings:
            result, _ = lay(Setting(name, "", name, config, spacing), length, full)
            cells.append(judge(result, true, spacing, seen) | {"spacing": spacing, "row": name})
            progress.advance(task)
        found.append(cells)
    return found


def chart_stability(found: list, true: Result, path: Path) -> None:
    film = 1e3 * float(true.height[touched(true)].mean())
    figure, axis = plt.subplots(figsize=(8.6, 0.62 * len(found) + 2.2))
    value = np.log([[c["height"] for c in row] for row in found])
    axis.imshow(value, cmap="YlOrBr", vmin=np.log(SHOWN[0]), vmax=np.log(SHOWN[1]), aspect="auto")
    for i, row in enumerate(found):
        for j, cell in enumerate(row):
            text = f"{cell['height']:.0f} µm   {100 * cell['laid']:+.0f} %"
            if cell["beads"]:
                text += f"\nbeads, {cell['tall']:.0f} µm"
            if not cell["sound"]:
                text = "not finite, not conserved, or overfull"
            dark = value[i, j] > np.log(0.6 * SHOWN[1])
            axis.text(j, i, text, ha="center", va="center", fontsize=8,
                      color="white" if dark else INK)  # fmt: skip
    axis.set_xticks(range(len(found[0])), [f"{c['spacing']:g}" for c in found[0]])
    axis.set_yticks(range(len(found)), [row[0]["row"] for row in found])
    axis.set_title("Where the simulator holds: error of height, and of the volume laid")
    axis.set_xlabel("between stamps [mm]; a pixel is 0.125 mm")
    axis.grid(False)
    figure.supxlabel(
        f"rms against `reference` in a film of {film:.0f} µm. Everywhere finite, conserved to 1e-6 "
        "and no cell overfull below the top, unless said otherwise.", fontsize=8, x=0.01, ha="left",
    )  # fmt: skip
    save_figure(figure, path)
