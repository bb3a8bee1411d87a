"""A color network that says how much of which paint is seen, and a mixture that makes the color.

The paper suggests it for what it could not solve: colors that a network paints itself drift, and
white over white turns purple (its section 6). Paint mixes channel by channel in the space of
`canvas.absorbed`, so what is seen at a pixel is a mean there of the brush's paint, of what its
bristles have picked up, and of what lay nearby. The network gives the shares. Then no color comes
out that did not go in; white on white stays white whatever the shares; and since shares do not
depend on colors, one pair teaches them for all.
"""

import jax
import jax.numpy as jnp

from jaxbrush.canvas import absorbed, from_srgb, reflected, to_srgb

COLORS = 9
"""Channels at the front of the inputs that are colors: canvas, brush, what was picked up."""
SPACING = 4
"""[pixels] between the places of the canvas that paint may come from."""
PLACES = tuple((SPACING * y, SPACING * x) for y in (-1, 0, 1) for x in (-1, 0, 1))
PAINTS = 2 + len(PLACES)
"""The brush's, what was picked up, and the canvas at `PLACES` around a pixel."""


def mix(logits, inputs):
    """The color of a mixture.

    Args:
      logits: (n, h, w, PAINTS), of the shares by softmax. inputs: (n, h, w, c) whose first `COLORS`
        channels are sRGB of the canvas, the brush and what was picked up, in [-1, 1].

    Returns:
      (n, h, w, 3) sRGB in [-1, 1].
    """
    # All at once: apart, XLA would work them out again for each of the places.
    colors = absorbed(from_srgb(0.5 * (inputs[..., :COLORS] + 1.0)))
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
    return 2.0 * to_srgb(reflected(mean)) - 1.0
