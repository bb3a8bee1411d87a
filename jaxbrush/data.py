"""Data sets of training pairs on disk: shards of fixed shape, a manifest, and what loads them.

A data set is a folder. `manifest.json` states format, configuration, seed and scales, and is
written first. Shard s holds the pairs of some canvases as `shard-00000.npy`, uint16 planes (pairs,
channels, h, w), and `shard-00000.json` with its checksum, written last: a shard without it does
not exist. Everything is written under another name and renamed, so a run may be killed at any
moment and goes on where it was.
"""

import dataclasses
import json
import os
import zlib
from pathlib import Path

import numpy as np

from jaxbrush.batches import LEVELS
from jaxbrush.brush import BrushConfig
from jaxbrush.paint import PaintConfig
from jaxbrush.pairs import PairConfig, Picture, canvas_pairs, canvases_pairs
from jaxbrush.structs import config

FORMAT = 14
FULL = 65535
CHANNELS = (
    ("height", 1), ("color", 3), ("pressure", 1), ("sweeps", 1), ("trajectory", 3), ("time", 1),
    ("load", 1), ("tip", 1), ("film", 1), ("hair", 1), ("picked", 3), ("lift", 1),
    ("new_height", 1), ("new_color", 3), ("mask", 1),
)  # fmt: skip
SPLITS = ("train", "test")
TESTS = 1_000_000
"""Number of the first test canvas: no set's test strokes are another's training strokes."""


class DataError(ValueError):
    """A data set that cannot be used: names the file and what is wrong with it."""


@config
class DataConfig:
    """pairs: how each is made. train, test: canvases of each split; they share no stroke. shard:
    canvases a file holds."""

    pairs: PairConfig = PairConfig()  # noqa: RUF009
    train: int = 12
    test: int = 4
    shard: int = 2

    def __post_init__(self):
        for name in ("train", "test", "shard"):
            value = getattr(self, name)
            if value < 1 or (name != "shard" and value % self.shard):
                raise ValueError(
                    f"DataConfig.{name} = {value}: expected a multiple of shard = {self.shard}"
                )

    @property
    def shards(self) -> int:
        return (self.train + self.test) // self.shard


PRESETS = {
    "tiny": DataConfig(PairConfig(), train=40, test=10, shard=2),
    "cpu": DataConfig(PairConfig(), train=500, test=28, shard=2),
    "small": DataConfig(
        PairConfig(size=256, strokes=5, stamps=768, way=34.0, bristles=256),
        train=200,
        test=25,
        shard=5,
    ),
    "paper": DataConfig(
        PairConfig(size=512, strokes=5, stamps=1408, way=61.0, bristles=256),
        train=2000,
        test=200,
        shard=5,
    ),
}
"""tiny: 160 + 40 pairs of 128 x 128. cpu: 2,000 + 112 such, what two cores make in an hour. small:
1,000 + 125 of 256 x 256. paper: 10,000 + 1,000 of 512 x 512, as many as the paper's."""


def _write(path: Path, data: bytes):
    partial = path.with_name(f"{path.name}.partial-{os.getpid()}")
    partial.write_bytes(data)
    os.replace(partial, path)


def _manifest(options: DataConfig, seed: int) -> dict:
    return {
        "format": FORMAT,
        "seed": seed,
        "config": json.loads(json.dumps(dataclasses.asdict(options))),
        "levels": LEVELS,
        "channels": [list(c) for c in CHANNELS],
        "shards": options.shards,
    }


def start(folder, options: DataConfig, seed: int) -> Path:
    """Makes the folder of a data set, or checks that it holds this one.

    Raises:
      DataError: it holds another one.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    path, want = folder / "manifest.json", _manifest(options, seed)
    if path.exists():
        have = _read_json(path)
        other = sorted(k for k in want if have.get(k) != want[k])
        if other:
            raise DataError(
                f"{path}: holds another data set ({', '.join(other)} differ): choose another "
                "folder, or delete this one"
            )
    else:
        _write(path, json.dumps(want, indent=1).encode())
    return folder


def _read_json(path: Path) -> dict:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be read ({error})") from error


def _pack(picture: Picture) -> np.ndarray:
    """(channels, h, w) uint16."""
    planes = []
    for name, count in CHANNELS:
        value = np.asarray(getattr(picture, name), np.float64)
        level = LEVELS.get(name.removeprefix("new_"), 1.0)
        value = np.moveaxis(value, -1, 0) if count > 1 else value[None]
        planes.append(np.round(np.clip(value / level, 0.0, 1.0) * FULL).astype(np.uint16))
    return np.concatenate(planes)


def shard_path(folder, number: int) -> Path:
    return Path(folder) / f"shard-{number:05d}.npy"


def make_shard(
    folder, options: DataConfig, seed: int, number: int, done=lambda: None, together: bool = False
) -> Path:
    """Paints the pairs of one shard and writes it; does nothing when it is there and sound.

    Args:
      done: called after each canvas. together: paints all canvases of the shard side by side.

    Returns:
      Path of the shard.
    """
    path = shard_path(folder, number)
    if path.with_suffix(".json").exists():
        try:
            check_shard(folder, options, number)
            return path
        except DataError:
            path.with_suffix(".json").unlink()
    planes, missed = [], 0
    canvases = range(number * options.shard, (number + 1) * options.shard)
    canvases = [c if c < options.train else TESTS + c - options.train for c in canvases]
    painted = (canvas_pairs(options.pairs, seed, canvas) for canvas in canvases)
    if together:
        painted = canvases_pairs(options.pairs, seed, canvases)
    for canvas, pictures in zip(canvases, painted, strict=True):
        for picture in pictures:
            if not np.all(np.isfinite(picture.new_height)):
                raise FloatingPointError(f"canvas {canvas}, seed {seed}: not finite")
            missed += not picture.reached
            planes.append(_pack(picture))
        done()
    planes = np.stack(planes)
    partial = path.with_name(f"{path.name}.partial-{os.getpid()}")
    with open(partial, "wb") as file:
        np.save(file, planes)
    os.replace(partial, path)
    note = {"pairs": len(planes), "crc32": zlib.crc32(planes.tobytes()), "missed": missed}
    _write(path.with_suffix(".json"), json.dumps(note).encode())
    return path


def check_shard(folder, options: DataConfig, number: int) -> np.ndarray:
    """The planes of a shard, mapped from disk.

    Raises:
      DataError: missing, truncated, damaged or foreign, with the name of the file.
    """
    path = shard_path(folder, number)
    note = _read_json(path.with_suffix(".json"))
    size, strokes = options.pairs.size, options.pairs.strokes
    shape = (options.shard * strokes, sum(n for _, n in CHANNELS), size, size)
    try:
        planes = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be read ({error})") from error
    if planes.shape != shape or planes.dtype != np.uint16:
        raise DataError(
            f"{path}: holds {planes.dtype} of shape {planes.shape}, expected uint16 of {shape}"
        )
    if zlib.crc32(np.ascontiguousarray(planes).tobytes()) != note.get("crc32"):
        raise DataError(f"{path}: is damaged (its checksum is not that of its .json)")
    return planes


@dataclasses.dataclass(frozen=True)
class Dataset:
    """An opened data set: `planes[split]` is a list of mapped arrays, one for each shard."""

    options: DataConfig
    seed: int
    planes: dict[str, list[np.ndarray]]

    def count(self, split: str) -> int:
        return sum(len(p) for p in self.planes[split])

    def take(self, split: str, index) -> dict[str, np.ndarray]:
        """Pairs by number as float32, (n, h, w, channels): height in mm, colors in sRGB."""
        each = len(self.planes[split][0])
        index = np.asarray(index)
        return _unpack(np.stack([self.planes[split][i // each][i % each] for i in index]))


def _unpack(planes) -> dict[str, np.ndarray]:
    """Named float32 maps (n, h, w, channels) of packed pairs (n, channels, h, w)."""
    out, at = {}, 0
    for name, count in CHANNELS:
        level = LEVELS.get(name.removeprefix("new_"), 1.0)
        value = np.moveaxis(planes[:, at : at + count], 1, -1)
        out[name] = value.astype(np.float32) * np.float32(level / FULL)
        at += count
    return out


def _config(values: dict) -> DataConfig:
    pairs = dict(values["pairs"])
    pairs["paint"] = PaintConfig(**pairs["paint"])
    pairs["brush"] = BrushConfig(**pairs["brush"])
    return DataConfig(**(values | {"pairs": PairConfig(**pairs)}))


def load(folder) -> Dataset:
    """Opens a finished data set and checks every shard.

    Raises:
      DataError: anything missing, damaged or foreign, by name.
    """
    folder = Path(folder)
    manifest = _read_json(folder / "manifest.json")
    if manifest.get("format") != FORMAT:
        raise DataError(
            f"{folder / 'manifest.json'}: format {manifest.get('format')!r}, expected {FORMAT}"
        )
    try:
        options = _config(manifest["config"])
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{folder / 'manifest.json'}: config: {error}") from error
    planes = [check_shard(folder, options, n) for n in range(options.shards)]
    first = options.train // options.shard
    return Dataset(options, manifest["seed"], {"train": planes[:first], "test": planes[first:]})
