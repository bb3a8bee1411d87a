"""What the networks are given: maps of canvas and stroke in network scale, and their targets.

Maps come as a dictionary, from a data set or from the painter, (n, h, w, channels) each.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.canvas import absorbed, from_srgb, reflected, to_srgb
from jaxbrush.loaded import COAT
from jaxbrush.mixing import COLORS, LEVEL
from jaxbrush.train import Batch

LEVELS = {
    "height": LEVEL, "pressure": 6.0, "sweeps": 64.0, "time": 64.0, "tip": COAT, "film": 1.25,
    "hair": 0.05,
}  # fmt: skip
"""Values that uint16's 65535 stands for: height [mm], pressure [maps' unit], sweeps, way of the
brush [mm], heights of a tip and of a film, thickness of hair [mm]; others 1."""


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


def _logarithm(x, linear, most):
    """[0, most] in network scale by its logarithm; about linear up to `linear`."""
    share = jnp.log1p(jnp.maximum(x, 0.0) / linear) / np.float32(np.log1p(most / linear))
    return _network(jnp.minimum(share, 1.0))


def network_sweeps(sweeps):
    """Sweep count in network scale, by its logarithm: grooves follow it, most where it is low."""
    return _logarithm(sweeps, 1.0, LEVELS["sweeps"])


WAY = 4.0
"""[mm] on which the networks' scale of the way is about linear; beyond, it grows as its logarithm,
so that long strokes keep a slope and stay within what was learned."""


def network_time(time):
    """The time map, the way of the brush [mm], in network scale."""
    return _logarithm(time, WAY, LEVELS["time"])


THIN = 0.01
"""[mm] of film up to which `network_thin` is about linear."""


def network_thin(film):
    """A film [mm] in network scale by its logarithm: of a dry brush it is hundredths of a
    millimetre thin, which `network_height` hardly tells from none."""
    return _logarithm(film, THIN, LEVELS["film"])


HANDS = ("pressure", "sweeps", "both")


def height_batch(
    pairs: dict, hand: str = "both", time: bool = True, load: bool = True, tip: bool = True,
    film: bool = True, hair: bool = True,
) -> Batch:  # fmt: skip
    """Inputs and target of the height network: background height, the hand, the way that the brush
    had gone, its load, how high its hair was, the film that it would leave, the hair in that film,
    and the film once more on a scale for thin ones -> new height.

    Args:
      hand: what tells of the hand, one of HANDS: the pressure map as in the paper, the sweep count
        (its Figure 3), or both. The pressure of the latest bristle says little of where hair is
        dense, and grooves are: on bare canvas their correlation with it is -0.01, with the
        logarithm of the count 0.26.
      time, load, tip, film, hair: whether these are given: a brush lays less as it empties, and
        thicker films where its hair is higher; grooves of single bristles are in the film, and
        ridges where there is little hair in it.

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
    if tip:
        high = jnp.asarray(pairs["tip"]) / LEVELS["tip"]
        parts.append(_network(jnp.where(touched(pairs), high, 1.0)))
    if film:
        parts.append(network_height(jnp.minimum(pairs["film"], LEVELS["film"])))
    if hair:
        part = jnp.asarray(pairs["hair"]) / LEVELS["hair"]
        parts.append(_network(jnp.minimum(part, 1.0)))
    if film:
        parts.append(network_thin(jnp.asarray(pairs["film"])))
    return Batch(
        inputs=jnp.concatenate(parts, axis=-1),
        target=network_height(jnp.asarray(pairs["new_height"])),
        mask=jnp.asarray(pairs["mask"]),
    )


def color_batch(
    pairs: dict, time: bool = True, height: bool = True, mixes: bool = False
) -> Batch:  # fmt: skip
    """Inputs and target of the color network: background color, color trajectory, time, new height
    -> new color, all in sRGB.

    Args:
      time, height: whether these maps are given (paper Figures 4 and 5). A network that mixes is
        else told that the paint hides the canvas.
      mixes: for a network that mixes colors: the brush's color wherever its paint may come to, the
        color that bristles had picked up; and besides time and new height how much they had, the
        height before, the sweep count and the load.
    """
    brush = jnp.asarray(pairs["trajectory"])
    if mixes:
        # Beside its bristles a brush of one color has the same one.
        brush = jnp.where(touched(pairs), brush, jnp.max(brush, axis=(1, 2), keepdims=True))
    parts = [_network(jnp.asarray(pairs["color"])), _network(brush)]
    if mixes:
        lift = jnp.asarray(pairs["lift"])
        picked = jnp.where(lift > 0.0, jnp.asarray(pairs["picked"]), brush)
        parts += [
            _network(picked),
            _network(lift),
            network_height(jnp.asarray(pairs["height"])),
            network_sweeps(jnp.asarray(pairs["sweeps"])),
            _network(jnp.asarray(pairs["load"])),
        ]
    if time:
        parts.append(network_time(jnp.asarray(pairs["time"])))
    if height:
        parts.append(network_height(jnp.asarray(pairs["new_height"])))
    elif mixes:
        parts.append(jnp.ones_like(parts[-1]))
    return Batch(
        inputs=jnp.concatenate(parts, axis=-1),
        target=_network(jnp.asarray(pairs["new_color"])),
        mask=jnp.asarray(pairs["mask"]),
    )


def single_batch(pairs: dict, mixes: bool = False, *told, **kwargs) -> Batch:
    """Inputs and target of one network for color and height (paper Figure 6): colors and, for one
    that mixes, how much was picked up; all that the height network is told (`height_batch`, whose
    arguments follow) -> new color and new height."""
    color = color_batch(pairs, time=False, height=False, mixes=mixes)
    height = height_batch(pairs, *told, **kwargs)
    # The rest of its inputs are among those of the height network.
    own = color.inputs[..., : COLORS + 1] if mixes else color.inputs
    return Batch(
        inputs=jnp.concatenate([own, height.inputs], axis=-1),
        target=jnp.concatenate([color.target, height.target], axis=-1),
        mask=height.mask,
    )


def recolored(batch: Batch, channels, scale) -> Batch:
    """A batch of the color network, or of one for color and height, as if all had been painted in
    other colors.

    Paint mixes channel by channel, by the mean of a power of its absorption over scattering
    (`canvas.mix_subtractive`): to permute channels and to scale this ratio is exact, but where a
    film is so thin that the ground shows through. A network that mixes is not shown colors, so it
    has nothing to learn from others.

    Args:
      channels: (3,) a permutation. scale: (3,) factor on the ratio of each channel, before that.
    """

    def change(x):
        ratio = scale[None, None, None] * absorbed(from_srgb(0.5 * (x + 1.0)), 1.0)
        return _network(to_srgb(reflected(ratio, 1.0)))[..., channels]

    before, stroke, rest = jnp.split(batch.inputs, (3, 6), axis=-1)
    none = jnp.all(stroke == -1.0, axis=-1, keepdims=True)
    colors = [change(before), jnp.where(none, -1.0, change(stroke))]
    inputs = jnp.concatenate([*colors, rest], axis=-1)
    color, height = jnp.split(batch.target, (3,), axis=-1)
    target = jnp.concatenate([change(color), height], axis=-1)
    return dataclasses.replace(batch, inputs=inputs, target=target)


PREVIEW_FILM = 0.22
"""[mm] that the preview lays: median where bristles came over bare canvas, in the training pairs
of the tiny data set, seed 0."""


def preview(pairs: dict) -> dict[str, jax.Array]:
    """The stroke from its maps alone: where bristles came, a film of one thickness and color."""
    cover = touched(pairs)
    height = jnp.where(cover, jnp.maximum(pairs["height"], PREVIEW_FILM), pairs["height"])
    return {
        "new_height": height,
        "new_color": jnp.where(cover, pairs["trajectory"], pairs["color"]),
    }
