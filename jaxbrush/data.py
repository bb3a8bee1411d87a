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

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.brush import BrushConfig
from jaxbrush.canvas import from_srgb, to_srgb
from jaxbrush.paint import PaintConfig
from jaxbrush.pairs import PairConfig, Picture, canvas_pairs, canvases_pairs
from jaxbrush.structs import config
from jaxbrush.train import Batch

FORMAT = 4
FULL = 65535
LEVELS = {"height": 1.25, "pressure": 6.0, "sweeps": 64.0, "time": 64.0}
"""Values that uint16's 65535 stands for: height [mm], pressure [maps' unit], sweeps, way of the
brush [mm]; others 1."""
CHANNELS = (
    ("height", 1), ("color", 3), ("pressure", 1), ("sweeps", 1), ("trajectory", 3), ("time", 1),
    ("load", 1), ("new_height", 1), ("new_color", 3), ("mask", 1),
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
    "tiny": DataConfig(PairConfig(), train=50, test=10, shard=2),
    "cpu": DataConfig(PairConfig(), train=320, test=28, shard=2),
    "small": DataConfig(
        PairConfig(size=256, strokes=5, stamps=576, bristles=256), train=200, test=25, shard=5
    ),
    "paper": DataConfig(
        PairConfig(size=512, strokes=5, stamps=1024, bristles=256), train=2000, test=200, shard=5
    ),
}
"""tiny: 200 + 40 pairs of 128 x 128. cpu: 1,280 + 112 such, what two cores make in
half an hour.
small: 1,000 + 125 of 256 x 256. paper: 10,000 + 1,000 of 512 x 512, as many as the paper's."""


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


def _network(x):
    """[0, 1] to the networks' [-1, 1]."""
    return 2.0 * x - 1.0


def network_height(height):
    """Height [mm] in network scale: 0 mm is -1, `LEVELS["height"]` is 1."""
    return _network(height / LEVELS["height"])


TOUCH = 0.2
"""Of [0, 1], what the pressure map shows where only the coat of paint touches."""


def touched(pairs: dict):
    """Where bristles came, (n, h, w, 1) bool: also those that touch with their coat alone, whose
    force is none."""
    return (jnp.asarray(pairs["time"]) > 0.0) | (jnp.asarray(pairs["pressure"]) > 0.0)


def network_pressure(pressure, touch):
    """Pressure in network scale, compressed by a root: most of a stroke is light. The rest, where
    nothing came, is told from the lightest touch (`touch`, bool) by a step of `TOUCH`."""
    share = jnp.sqrt(jnp.clip(pressure / LEVELS["pressure"], 0.0, 1.0))
    return _network(jnp.where(touch, TOUCH + (1.0 - TOUCH) * share, 0.0))


def network_sweeps(sweeps):
    """Sweep count in network scale, by its logarithm: grooves follow it, most where it is low."""
    share = jnp.log1p(jnp.maximum(sweeps, 0.0)) / np.float32(np.log1p(LEVELS["sweeps"]))
    return _network(jnp.minimum(share, 1.0))


WAY = 4.0
"""[mm] on which the networks' scale of the way is about linear; beyond, it grows as its logarithm,
so that long strokes keep a slope and stay within what was learned."""


def network_time(time):
    """The time map, the way of the brush [mm], in network scale."""
    share = jnp.log1p(jnp.maximum(time, 0.0) / WAY) / np.float32(np.log1p(LEVELS["time"] / WAY))
    return _network(jnp.minimum(share, 1.0))


HANDS = ("pressure", "sweeps", "both")


def height_batch(pairs: dict, hand: str = "both", time: bool = True, load: bool = True) -> Batch:
    """Inputs and target of the height network: background height, the hand, the way that the brush
    had gone, its load -> new height.

    Args:
      hand: what tells of the hand, one of HANDS: the pressure map as in the paper, the sweep count
        (its Figure 3), or both. The pressure of the latest bristle says little of where hair is
        dense, and grooves are: on bare canvas their correlation with it is -0.01, with the
        logarithm of the count 0.26.
      time, load: whether these are given: a brush lays less as it empties.

    Raises:
      ValueError: another hand.
    """
    if hand not in HANDS:
        raise ValueError(f"hand = {hand!r}: expected one of {HANDS}")
    parts = [network_height(pairs["height"])]
    if hand != "sweeps":
        parts.append(network_pressure(jnp.asarray(pairs["pressure"]), touched(pairs)))
    if hand != "pressure":
        parts.append(network_sweeps(jnp.asarray(pairs["sweeps"])))
    if time:
        parts.append(network_time(jnp.asarray(pairs["time"])))
    if load:
        parts.append(_network(jnp.asarray(pairs["load"])))
    return Batch(
        inputs=jnp.concatenate(parts, axis=-1),
        target=network_height(jnp.asarray(pairs["new_height"])),
        mask=jnp.asarray(pairs["mask"]),
    )


def color_batch(pairs: dict, time: bool = True, height: bool = True) -> Batch:
    """Inputs and target of the color network: background color, color trajectory, time, new height
    -> new color, all in sRGB.

    Args:
      time, height: whether these maps are given (paper Figures 4 and 5).
    """
    parts = [_network(jnp.asarray(pairs["color"])), _network(jnp.asarray(pairs["trajectory"]))]
    if time:
        parts.append(network_time(jnp.asarray(pairs["time"])))
    if height:
        parts.append(network_height(jnp.asarray(pairs["new_height"])))
    return Batch(
        inputs=jnp.concatenate(parts, axis=-1),
        target=_network(jnp.asarray(pairs["new_color"])),
        mask=jnp.asarray(pairs["mask"]),
    )


def recolored(batch: Batch, channels, scale) -> Batch:
    """A batch of the color network as if all had been painted in other colors.

    Paint mixes channel by channel, by the mean of a power of its absorption over scattering
    (`canvas.mix_subtractive`): to permute channels and to scale this ratio is exact, but where a
    film is so thin that the ground shows through.

    Args:
      channels: (3,) a permutation. scale: (3,) factor on the ratio of each channel, before that.
    """

    def change(x):
        bright = jnp.clip(from_srgb(0.5 * (x + 1.0)), 1e-3, 0.999)
        ratio = scale[None, None, None] * (1.0 - bright) ** 2 / (2.0 * bright)
        bright = 1.0 / (1.0 + ratio + jnp.sqrt(ratio * ratio + 2.0 * ratio))
        return _network(to_srgb(bright))[..., channels]

    before, stroke, rest = jnp.split(batch.inputs, (3, 6), axis=-1)
    none = jnp.all(stroke == -1.0, axis=-1, keepdims=True)
    stroke = jnp.where(none, -1.0, change(stroke))
    inputs = jnp.concatenate([change(before), stroke, rest], axis=-1)
    return dataclasses.replace(batch, inputs=inputs, target=change(batch.target))


PREVIEW_FILM = 0.227
"""[mm] that the preview lays: median where bristles came over bare canvas, in the 48 training pairs
of the tiny data set, seed 0."""


def preview(pairs: dict) -> dict[str, jax.Array]:
    """The stroke from its maps alone: where bristles came, a film of one thickness and color."""
    cover = touched(pairs)
    height = jnp.where(cover, jnp.maximum(pairs["height"], PREVIEW_FILM), pairs["height"])
    return {
        "new_height": height,
        "new_color": jnp.where(cover, pairs["trajectory"], pairs["color"]),
    }
