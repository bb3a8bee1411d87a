"""A color network that says how much of which paint is seen, and a mixture that makes the color.

The paper suggests it for what it could not solve: colors that a network paints itself drift, and
white over white turns purple (its section 6). Paint mixes channel by channel in the space of
`canvas.absorbed`, so what is seen at a pixel is a mean there of the brush's paint, of what its
bristles have picked up, and of what lay nearby. The network gives the shares. Then no color comes
out that did not go in; white on white stays white whatever the shares; and since shares do not
depend on colors, one pair teaches them for all.

Through a thin film the canvas shows. That is light that adds up, not paint that mixes, and how much
of it is known: it goes with the height (`canvas.flatten`). So the mixture is that of the paint
alone, laid over the ground. Mixed with it, a dry orange turns yellow where it should turn pink.
"""

import jax
import jax.numpy as jnp

from jaxbrush.canvas import LINEN, OPACITY, absorbed, from_srgb, reflected, to_srgb

COLORS = 9
"""Channels at the front of the inputs that are colors: canvas, brush, what was picked up."""
BEFORE = COLORS + 1
"""Channel of the height before; how much was picked up comes between."""
LEVEL = 1.25
"""Height of the paint [mm] that is 1 in network scale; 0 mm is -1."""
THIN = 0.5
"""Share of the light that comes from under the paint, above which a film counts as the ground that
it lies on: what it is made of is not to be told from its color any more."""
SPACING = 4
"""[pixels] between the places of the canvas that paint may come from."""
PLACES = tuple((SPACING * y, SPACING * x) for y in (-1, 0, 1) for x in (-1, 0, 1))
PAINTS = 2 + len(PLACES)
"""The brush's, what was picked up, and the canvas at `PLACES` around a pixel."""


def bare(height):
    """Share of the light that comes from under paint of a height, in network scale."""
    return jnp.exp(-(0.5 * LEVEL / OPACITY) * jnp.maximum(height + 1.0, 0.0))


def mix(logits, inputs, height):
    """The color of a mixture over the ground.

    Args:
      logits: (n, h, w, PAINTS), of the shares by softmax. inputs: (n, h, w, c) whose first `COLORS`
        channels are sRGB of the canvas, the brush and what was picked up, in [-1, 1], and channel
        `BEFORE` the height before. height: (n, h, w, 1) after; heights in network scale.

    Returns:
      (n, h, w, 3) sRGB in [-1, 1].
    """
    before = bare(inputs[..., BEFORE : BEFORE + 1])
    linear = from_srgb(0.5 * (inputs[..., :COLORS] + 1.0))
    canvas, others = linear[..., :3], linear[..., 3:]
    thin = before > THIN
    ground = jnp.where(thin, canvas, jnp.asarray(LINEN, canvas.dtype)[None, None, None])
    paint = (canvas - before * ground) / (1.0 - jnp.where(thin, THIN, before))
    paint = jnp.where(thin, canvas, jnp.clip(paint, 0.0, 1.0))
    # All at once: apart, XLA would work them out again for each of the places.
    colors = absorbed(jnp.concatenate([paint, others], axis=-1))
    canvas, brush, picked = jnp.split(colors, 3, axis=-1)
    shares = jax.nn.softmax(logits, axis=-1)
    mean = shares[..., :1] * brush + shares[..., 1:2] * picked
    h, w = canvas.shape[1:3]
    around = jnp.pad(canvas, ((0, 0), (SPACING, SPACING), (SPACING, SPACING), (0, 0)), "edge")
    for k, (y, x) in enumerate(PLACES, 2):
        there = jax.lax.slice(
            around, (0, SPACING + y, SPACING + x, 0),
            (around.shape[0], SPACING + y + h, SPACING + x + w, 3),
        )  # fmt: skip
        mean = mean + shares[..., k : k + 1] * there
    shows = bare(height)
    return 2.0 * to_srgb(reflected(mean) * (1.0 - shows) + ground * shows) - 1.0
