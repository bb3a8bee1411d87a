"""Errors of a network on pairs, beside the two baselines: what every training run reports."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush import metrics
from jaxbrush.canvas import from_srgb
from jaxbrush.mixing import bare
from jaxbrush.models import Generator, GeneratorConfig, inputs_of
from jaxbrush.train import Batch, weights_of

TOGETHER = 4  # pairs evaluated at once
COLUMNS = {
    "height": ("whole", "mask", "whole [0,1]", "mask [0,1]", "volume %", "normal °",
               "light %"),
    "color": ("whole", "mask", "whole [0,1]", "mask [0,1]", "ΔE", "ΔE p95", "off hull %"),
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Scale:
    """height: what 1 in network scale stands for, -1 being bare canvas [mm]. pixel: side [mm]."""

    height: float
    pixel: float


@dataclasses.dataclass(frozen=True)
class Pairs:
    """Pairs in network scale. batch: all of them, float32 arrays on the host or the device.
    background: (n, h, w, k) what was there before. preview: (n, h, w, k), what the stroke's maps
    alone give."""

    batch: Batch
    background: np.ndarray | jax.Array
    preview: np.ndarray | jax.Array

    def __len__(self):
        return len(self.batch.target)

    def __getitem__(self, index) -> "Pairs":
        return jax.tree.map(lambda x: x[index], self)

    @property
    def nbytes(self) -> int:
        return sum(x.nbytes for x in jax.tree.leaves(self.batch))

    def take(self, index) -> Batch:
        """The pairs of these numbers, on the host."""
        return jax.tree.map(lambda x: np.asarray(x)[index], self.batch)


jax.tree_util.register_dataclass(Pairs, ["batch", "background", "preview"], [])


def _common(found, true, mask):
    return {
        "whole": metrics.rmse(found, true),
        "masked": metrics.rmse(found, true, mask),
        "area": jnp.sum(mask),
        "octaves": jnp.stack([metrics.octave_power(found), metrics.octave_power(true)]),
    }


def _height(found, true, mask, inputs, scale: Scale):
    """Of one pair, (h, w, 1)."""
    a, b = (scale.height * metrics.image_scale(x)[..., 0] for x in (found, true))
    angles = metrics.normal_angles(a, b, scale.pixel)
    return _common(found, true, mask) | {
        "volume": jnp.sum(mask[..., 0] * b),
        "excess": jnp.sum(mask[..., 0] * (a - b)),
        "normal": metrics.weighted_mean(angles, mask),
        "light": metrics.weighted_mean(jnp.abs(bare(found) - bare(true))[..., 0], mask),
    }


def _color(found, true, mask, inputs, scale: Scale):
    """Of one pair, (h, w, 3) sRGB; inputs start with background and trajectory."""
    linear = lambda x: from_srgb(metrics.image_scale(x))  # noqa: E731
    a, b = linear(found), linear(true)
    difference = metrics.delta_e(a, b)
    went_in = linear(inputs[..., :6].reshape(-1, 3))
    # Every fourth pixel is enough of a sample, and a sixteenth of the work, which is the most here.
    few = (slice(None, None, 4), slice(None, None, 4))
    outside = metrics.out_of_hull(a[few], metrics.extremes(went_in, 32), mask[few])
    inside = jnp.where(mask[..., 0] > 0.0, difference, jnp.nan)
    return _common(found, true, mask) | {
        "delta_e": metrics.weighted_mean(difference, mask),
        "delta_e_p95": jnp.nan_to_num(jnp.nanpercentile(inside, 95.0)),
        "outside": outside,
    }


@functools.partial(jax.jit, static_argnames=("kind", "scale"))
def _measured(kind, found, batch, scale):
    one = {"height": _height, "color": _color}[kind]
    return jax.vmap(functools.partial(one, scale=scale))(
        found, batch.target, batch.mask, batch.inputs
    )


def errors(kind: str, found, batch: Batch, scale: Scale) -> dict:
    """Errors of pictures, pooled over pairs.

    Args:
      kind: "height" or "color". found: (n, h, w, k) network scale. batch: inputs and truth.

    Returns:
      Plain values. rmse_*: root of the mean over all pixels of all pairs, network scale, and image
      scale [0, 1] at half of it. Height, in the mask: volume_bias, normal angle [degrees], and the
      mean difference of the light that comes through (`mixing.bare`). Color: CIEDE2000, p95 of
      which is the mean over pairs, and the share of pixels outside the hull, in linear RGB, of
      background and brush. spectrum: power over the true one by octave, finest first.
    """
    parts = []
    for first in range(0, len(found), TOGETHER):
        piece = slice(first, first + TOGETHER)
        few = jax.tree.map(lambda x, piece=piece: jnp.asarray(x[piece]), batch)
        parts.append(jax.device_get(_measured(kind, jnp.asarray(found[piece]), few, scale)))
    each = jax.tree.map(lambda *x: np.concatenate(x).astype(np.float64), *parts)
    area = each["area"] / max(each["area"].sum(), 1.0)
    ours, true = each["octaves"].sum(0)
    whole = np.sqrt(np.mean(each["whole"] ** 2))
    masked = np.sqrt(np.sum(area * each["masked"] ** 2))
    out = {
        "rmse_whole": whole,
        "rmse_masked": masked,
        "rmse_whole_image": whole / 2.0,
        "rmse_masked_image": masked / 2.0,
        "spectrum": np.asarray(metrics.spectrum_ratio(jnp.asarray(ours), jnp.asarray(true))),
    }
    if kind == "height":
        out["volume_bias"] = each["excess"].sum() / max(each["volume"].sum(), 1e-12)
        out["normal_angle"] = np.sum(area * each["normal"])
        out["light"] = np.sum(area * each["light"])
    else:
        out["delta_e"] = np.sum(area * each["delta_e"])
        out["delta_e_p95"] = np.mean(each["delta_e_p95"])
        out["out_of_hull"] = np.sum(area * each["outside"])
    return jax.tree.map(lambda x: x.tolist(), out)


@functools.partial(jax.jit, static_argnums=0)
def _painted(options, variables, batch):
    return Generator(options).apply(variables, batch.inputs, weights_of(options.norm, batch.mask))


def paint(options: GeneratorConfig, variables: dict, batch: Batch) -> np.ndarray:
    """The network's pictures of all pairs, (n, h, w, k).

    Raises:
      ValueError: a network of other inputs.
    """
    have, given = inputs_of(options, variables["params"]), batch.inputs.shape[-1]
    if have != given:
        raise ValueError(f"a network of {have} inputs: expected {given}, one for each map given")
    out = []
    for first in range(0, len(batch.inputs), TOGETHER):
        piece = slice(first, first + TOGETHER)
        few = jax.tree.map(lambda x, piece=piece: jnp.asarray(x[piece]), batch)
        out.append(jax.device_get(_painted(options, variables, few)))
    return np.concatenate(out)


def parts(kind: str, found, pairs: Pairs) -> dict[str, tuple[np.ndarray, Pairs]]:
    """Pictures and pairs of height and color, by their names: of a single network both."""
    if kind != "single":
        return {kind: (found, pairs)}
    split = {}
    for name, channels in (("color", slice(0, 3)), ("height", slice(3, 4))):
        of = lambda x, which=channels: x[..., which]  # noqa: E731
        batch = dataclasses.replace(pairs.batch, target=of(pairs.batch.target))
        split[name] = of(found), Pairs(batch, of(pairs.background), of(pairs.preview))
    return split


def compare(kind: str, found, pairs: Pairs, scale: Scale) -> dict[str, dict]:
    """Errors of the network's pictures, of the two baselines, and, for what truth itself has (such
    as colors out of the hull), of the simulator."""
    rows = {
        "the network": found,
        "copy the background": pairs.background,
        "the preview stroke": pairs.preview,
        "the simulator": pairs.batch.target,
    }
    return {name: errors(kind, row, pairs.batch, scale) for name, row in rows.items()}


def table(kind: str, rows: dict[str, dict]) -> tuple[list[str], list[list[str]]]:
    """Columns and rows of what `compare` found, as text; of the spectrum the three finest octaves,
    power over the true one."""
    measures = ["rmse_whole", "rmse_masked", "rmse_whole_image", "rmse_masked_image"]
    texts = []
    for name, row in rows.items():
        text = [name] + [f"{row[m]:.4f}" for m in measures]
        if kind == "height":
            text += [f"{100 * row['volume_bias']:+.1f}", f"{row['normal_angle']:.2f}"]
            text += [f"{100 * row['light']:.1f}"]
        else:
            text += [f"{row['delta_e']:.2f}", f"{row['delta_e_p95']:.2f}"]
            text += [f"{100 * row['out_of_hull']:.2f}"]
        texts.append(text + [" ".join(f"{x:.1f}" for x in row["spectrum"][:3])])
    return ["RMSE", *COLUMNS[kind], "fine power"], texts
