"""Paints a recorded session again, stroke by stroke, with one of three engines.

python -m experiments.paint_session                              # a picture that comes along
python -m experiments.paint_session --engine offline             # by the simulator
python -m experiments.paint_session --recording FILE --pixels 512 512
"""

import dataclasses
import os
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import tyro
from PIL import Image
from rich.progress import track

from experiments import engines, paint_scenes
from experiments.common import console, helped, print_table, results_folder, write_run
from jaxbrush import recordings
from jaxbrush.batches import LEVELS
from jaxbrush.canvas import Canvas, to_srgb
from jaxbrush.paint import RELIEF, weave
from jaxbrush.render import picture, shade

FRAME = 480
"""Longest side of the time-lapse [pixels]."""


@dataclasses.dataclass(frozen=True)
class Config:
    """Paints a session, and says what each stage of each stroke took."""

    recording: Path | None = None
    """A session of jaxbrush (.jsonl), of libmypaint (.dat) or of a Wacom pad (.jsonl.gz) [default:
    a scene]."""
    scene: Literal["sea", "dry"] = "sea"
    """A sheet of show_paint, as a pen would have drawn it: painted where no recording is given."""
    engine: Literal["neural", "realtime", "offline"] = "neural"
    """The networks, the simulator at its fastest setting, or as the networks were taught."""
    pixels: tuple[int, int] | None = None
    """Height and width of the canvas, which the recording is scaled to [default: its own]."""
    relief: float | None = None
    """Depth of the canvas's weave [mm] [default: that of the scene, else 0.03]; on a coarse one of
    0.06 to 0.1 a dry brush catches."""
    strokes: int | None = None
    """Paints the first so many only."""
    weights: tuple[Path, Path] = engines.SHIPPED
    """Height and color network."""
    out: Path | None = None
    """Folder for the pictures [default: results/paint_session]."""
    quick: bool = False
    """Six strokes."""


def read(path: Path | None, scene: str = "sea") -> recordings.Session:
    """A recorded session of any format, or a scene that comes along.

    Raises:
      RecordingError: the file, its line and what was expected there.
    """
    if path is None:
        return paint_scenes.recorded(scene)
    if path.suffix == ".dat":
        return recordings.read_mypaint(path)
    return recordings.read_wacom(path) if path.suffix == ".gz" else recordings.read(path)


def save(path: Path, image: np.ndarray) -> None:
    """Writes a picture (RGB or gray) under another name and renames it."""
    coded, data = cv2.imencode(path.suffix, image[..., ::-1] if image.ndim == 3 else image)
    if not coded:
        raise ValueError(f"{path}: a picture of {image.shape} cannot be coded")
    partial = path.with_name(path.name + ".partial")
    partial.write_bytes(data.tobytes())
    os.replace(partial, path)


def lit(canvas: Canvas, relief: float = RELIEF) -> np.ndarray:
    """The canvas under a lamp, its weave `relief` [mm] deep, 8-bit RGB."""
    cloth = weave(canvas.height.shape, engines.PIXEL, relief)
    return np.asarray(picture(shade(canvas, engines.PIXEL, weave=cloth)))


def frame(canvas: Canvas, relief: float) -> Image.Image:
    """A picture of the time-lapse."""
    image = Image.fromarray(lit(canvas, relief))
    image.thumbnail((FRAME, FRAME))
    return image.quantize(128)


def stages_of(spent: list[dict]) -> list[list]:
    """Rows of a table: stage; ms a stroke: median, 95th percentile, worst, first (compiling)."""
    rows = []
    for name in dict.fromkeys(n for s in spent for n in s):
        took = 1e3 * np.asarray([s.get(name, 0.0) for s in spent])
        rows.append([name, *(f"{x:.1f}" for x in (*np.percentile(took, (50, 95, 100)), took[0]))])
    return rows


def main(options: Config) -> None:
    try:
        relief = options.relief
        if relief is None:
            relief = RELIEF if options.recording else paint_scenes.relief_of(options.scene)
        session = read(options.recording, options.scene)
        side = np.asarray(session.canvas)[::-1] / engines.PIXEL
        shape = tuple(int(n) for n in options.pixels or np.ceil(side))
        deeds = engines.deeds_of(session, shape)
        engine = engines.make(options.engine, shape, deeds, options.weights, relief)
    except (ValueError, OSError) as error:
        raise SystemExit(f"{error}") from error
    if not deeds:
        raise SystemExit(f"{options.recording}: no strokes in it")
    folder = results_folder("paint_session", options.out)
    deeds = deeds[: 6 if options.quick else options.strokes]
    spent, frames = [], [frame(engine.canvas(), relief)]
    every = max(1, len(deeds) // 60)
    for number, deed in enumerate(track(deeds, f"{options.engine} paints", console=console), 1):
        spent.append(engine.paint(deed))
        if number % every == 0 or number == len(deeds):
            frames.append(frame(engine.canvas(), relief))
    canvas = engine.canvas()
    height = np.clip(np.asarray(canvas.height) / LEVELS["height"], 0.0, 1.0)
    save(folder / "height.png", (65535.0 * height + 0.5).astype(np.uint16))
    save(folder / "color.png", (255.0 * np.asarray(to_srgb(canvas.color)) + 0.5).astype(np.uint8))
    save(folder / "lit.png", lit(canvas, relief))
    partial = folder / "timelapse.partial"
    frames[0].save(partial, "GIF", save_all=True, append_images=frames[1:], duration=120, loop=0)
    os.replace(partial, folder / "timelapse.gif")
    recordings.write(folder / "session.jsonl", session)
    write_run(folder, options, {"spent": spent, "shape": shape, "strokes": len(deeds)})
    whole = [sum(s.values()) for s in spent]
    print_table(
        f"{len(deeds)} strokes by {options.engine} on {shape[0]} x {shape[1]} pixels",
        ["ms a stroke", "median", "95 %", "worst", "first"],
        [*stages_of(spent), *stages_of([{"all": w} for w in whole])],
    )
    console.print(
        f"{folder}: lit.png, color.png, height.png (65535 is {LEVELS['height']} mm), timelapse.gif"
    )


if __name__ == "__main__":
    main(tyro.cli(Config, description=helped(__doc__)))
