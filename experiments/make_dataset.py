"""Makes the data set: pairs of canvases before and after one more stroke, from the simulator.

python -m experiments.make_dataset                      # tiny, some minutes on 2 cores
python -m experiments.make_dataset --preset small       # 1,000 + 125 pairs, hours
python -m experiments.make_dataset --preset paper --shard 3/16    # one of 16 machines
"""

import dataclasses
import os
import re
import selectors
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated, Literal

import cv2
import jax
import numpy as np
import tyro
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from experiments.common import console, helped, print_table
from jaxbrush import batches, data
from jaxbrush.canvas import Canvas, from_srgb
from jaxbrush.render import picture, shade

SHEET = 8
"""Pairs on the contact sheet."""


@dataclasses.dataclass(frozen=True)
class Config:
    """A data set of training pairs; goes on where an earlier run stopped."""

    preset: Literal["tiny", "cpu", "small", "paper"] = "tiny"
    """160 + 40 or 2,000 + 112 pairs of 128 x 128, 1,000 + 125 of 256 x 256, or 10,000 + 1,000 of
    512 x 512."""
    out: Path | None = None
    """Folder of the set [default: results/data_<preset>]."""
    seed: int = 0
    """Every pair depends on the seed and its number only."""
    shard: Annotated[str | None, tyro.conf.arg(metavar="I/N")] = None
    """Makes every N-th shard from the I-th on (from 0): one of N machines."""
    workers: int = 0
    """Processes [default: one for each core; a single one where there is an accelerator]."""


def part_of(text: str | None, count: int) -> list[int]:
    """Numbers of the shards of a part "i/n" of `count`; all of them for None."""
    if text is None:
        return list(range(count))
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    if not found or not int(found[1]) < int(found[2]):
        raise SystemExit(f"--shard {text}: expected I/N with 0 <= I < N")
    return list(range(int(found[1]), count, int(found[2])))


def folder_of(preset: str, out: Path | None) -> Path:
    return Path("results") / f"data_{preset}" if out is None else Path(out)


def cores() -> list[int]:
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def work(folder: Path, preset: str, seed: int, numbers: list[int]) -> None:
    """What one process does: a line for each canvas that is finished. On an accelerator, the
    canvases of a shard side by side."""
    options, together = data.PRESETS[preset], jax.default_backend() != "cpu"
    for number in numbers:
        tell = lambda: print("canvas", flush=True)  # noqa: E731
        data.make_shard(folder, options, seed, number, tell, together)


def processes_of(wanted: int, cores: int, shards: int) -> int:
    """How many processes make a data set: as many as are wanted, else one for each core, or a
    single one that has the accelerator. Asked of another process, for who asks takes hold of it."""
    if not wanted:
        ask = [sys.executable, "-c", "import jax; print(jax.default_backend())"]
        found = subprocess.run(ask, capture_output=True, text=True, check=False).stdout.split()
        wanted = cores if found[-1:] == ["cpu"] else 1
    return max(1, min(wanted, shards))


def make(folder: Path, preset: str, seed: int, numbers: list[int], workers: int) -> None:
    """Makes shards in `workers` processes, one core each, with a progress bar in pairs."""
    options = data.PRESETS[preset]
    data.start(folder, options, seed)
    numbers = [n for n in numbers if not _sound(folder, options, n, tell=True)]
    if not numbers:
        return
    own = cores()
    workers = processes_of(workers, len(own), len(numbers))
    processes = []
    for k in range(workers):
        command = [sys.executable, "-m", "experiments.make_dataset", "--worker"]
        command += [str(folder), preset, str(seed), ",".join(map(str, numbers[k::workers]))]
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        # One core each: XLA gains less from two in one stroke.
        if workers > 1 and hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(process.pid, {own[k % len(own)]})
        processes.append(process)
    each = options.pairs.strokes
    columns = (
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed} pairs"),
        TextColumn("{task.fields[rate]}"), TimeElapsedColumn(), TimeRemainingColumn(),
    )  # fmt: skip
    start = time.perf_counter()
    try:
        with Progress(*columns, console=console) as bar:
            task = bar.add_task("painting", total=len(numbers) * options.shard * each, rate="")
            done = 0
            for _ in _lines(processes):
                done += each
                rate = f"{done / (time.perf_counter() - start):.2f} pairs/s"
                bar.update(task, completed=done, rate=rate)
    finally:
        for process in processes:
            process.terminate()
    for process in processes:
        error = process.stderr.read()
        if process.wait() not in (0, -15) or not all(_sound(folder, options, n) for n in numbers):
            raise SystemExit(f"a worker stopped (exit {process.returncode}):\n{error[-3000:]}")


def _sound(folder, options, number, tell=False) -> bool:
    try:
        data.check_shard(folder, options, number)
    except data.DataError as error:
        if tell and data.shard_path(folder, number).exists():
            console.print(f"{error}: made anew")
        return False
    return True


def _lines(processes):
    """Lines that several processes print, as they come."""
    ready = selectors.DefaultSelector()
    for process in processes:
        ready.register(process.stdout, selectors.EVENT_READ)
    while ready.get_map():
        for key, _ in ready.select():
            line = key.fileobj.readline()
            if line:
                yield line
            else:
                ready.unregister(key.fileobj)


def sheet(found: data.Dataset, path: Path) -> None:
    """The contact sheet (paper Figure 7): a row a pair, its maps from left to right."""
    count = found.count("train")
    pairs = found.take("train", np.linspace(0, count - 1, min(SHEET, count)).astype(int))
    pixel = found.options.pairs.paint.pixel
    gray = lambda x: np.repeat(np.clip(x, 0.0, 1.0), 3, axis=-1)  # noqa: E731
    rows = []
    for k in range(len(pairs["height"])):
        p = {name: value[k] for name, value in pairs.items()}
        after = Canvas(height=p["new_height"][..., 0], color=from_srgb(p["new_color"]))
        lit = picture(shade(after, pixel))
        rows.append(np.hstack([
            gray(p["height"] / 0.8), p["color"], gray(np.sqrt(p["pressure"] / 4.0)),
            gray(p["tip"] / batches.LEVELS["tip"]), gray(p["film"] / 0.8),
            gray(np.sqrt(p["hair"] / batches.LEVELS["hair"])), p["trajectory"], p["picked"],
            gray(p["time"] / max(p["time"].max(), 1e-6)),
            gray(p["new_height"] / 0.8), p["new_color"], np.asarray(lit) / 255.0,
        ]))  # fmt: skip
    image = (255.0 * np.vstack(rows)[..., ::-1]).astype(np.uint8)
    partial = path.with_name("partial.png")
    cv2.imwrite(str(partial), image)
    os.replace(partial, path)


def build(preset: str, out: Path | None = None, seed: int = 0, workers: int = 0) -> Path:
    """Makes a whole data set if it is not there; returns its folder. A folder that is named and
    holds a set of another make is taken as it is."""
    folder = folder_of(preset, out)
    if out is not None and (folder / "manifest.json").exists():
        try:
            data.start(folder, data.PRESETS[preset], seed)
        except data.DataError:
            return folder
    make(folder, preset, seed, part_of(None, data.PRESETS[preset].shards), workers)
    return folder


def main(options: Config) -> None:
    preset = data.PRESETS[options.preset]
    folder = folder_of(options.preset, options.out)
    numbers = part_of(options.shard, preset.shards)
    start = time.perf_counter()
    make(folder, options.preset, options.seed, numbers, options.workers)
    pairs = len(numbers) * preset.shard * preset.pairs.strokes
    rows = [["pairs made or found", pairs], ["time [s]", f"{time.perf_counter() - start:.0f}"]]
    if len(numbers) == preset.shards:
        found = data.load(folder)
        sheet(found, folder / "sheet.png")
        size = sum(p.nbytes for split in found.planes.values() for p in split)
        rows += [
            ["train + test", f"{found.count('train')} + {found.count('test')}"],
            ["size [MiB]", f"{size / 2**20:.0f}"],
            ["contact sheet", folder / "sheet.png"],
        ]
    print_table(f"Data set {folder}", ["", "value"], rows)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--worker"]:
        target, name, number, which = sys.argv[2:6]
        work(Path(target), name, int(number), [int(n) for n in which.split(",")])
    else:
        main(tyro.cli(Config, description=helped(__doc__)))
