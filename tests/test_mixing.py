"""Colors as mixtures: what went in comes out, whatever a network says; a naive one drifts."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbrush import mixing
from jaxbrush.batches import network_height
from jaxbrush.canvas import (
    LINEN,
    OPACITY,
    absorbed,
    flatten,
    from_srgb,
    mix_subtractive,
    reflected,
    to_srgb,
)
from jaxbrush.models import Generator, GeneratorConfig, inputs_of

SIDE = 16


def plain(logits, inputs):
    """The mixture on the new height that a color network is told."""
    return mixing.mix(logits, inputs, inputs[..., -1:])


mix = jax.jit(plain)


def inputs_like(rng, more=6):
    """Random colors and maps, (1, h, w, 9 + more) in network scale; paint that hides the ground."""
    colors = rng.uniform(-0.9, 0.9, (1, SIDE, SIDE, mixing.COLORS))
    maps = rng.uniform(-1.0, 1.0, (1, SIDE, SIDE, more))
    maps[..., [mixing.BEFORE - mixing.COLORS, -1]] = rng.uniform(-0.2, 1.0, (1, SIDE, SIDE, 2))
    return jnp.asarray(np.concatenate([colors, maps], -1), jnp.float32)


def recolored(x, channels, scale):
    """Colors (..., 3 n) as of other paints, for which mixtures are as true."""
    colors = x.reshape(*x.shape[:-1], -1, 3)
    ratio = scale * absorbed(from_srgb(0.5 * (colors + 1.0)), 1.0)
    return (2.0 * to_srgb(reflected(ratio, 1.0)) - 1.0)[..., channels].reshape(x.shape)


def logits_like(rng, spread=2.0):
    return jnp.asarray(rng.normal(0.0, spread, (1, SIDE, SIDE, mixing.PAINTS)), jnp.float32)


def network(mixes, inputs, seed=0):
    """A generator of large random weights."""
    config = GeneratorConfig(outputs=3, width=0.05, norm="none", mixes=mixes)
    run = Generator(config)
    shapes = jax.eval_shape(run.init, jax.random.key(0), jnp.zeros((1, SIDE, SIDE, inputs)))
    rng = np.random.default_rng(seed)
    draw = lambda x: jnp.asarray(rng.normal(0.0, 0.3, x.shape), jnp.float32)  # noqa: E731
    return config, jax.tree.map(draw, shapes), jax.jit(run.apply)


def in_hull(found, inputs):
    """How far colors leave what went in near a pixel, in the space where paint mixes."""
    space = lambda x: np.asarray(absorbed(from_srgb(0.5 * (x + 1.0))))  # noqa: E731
    canvas, brush, picked = (space(inputs[..., k : k + 3]) for k in (0, 3, 6))
    around = np.pad(canvas, ((0, 0), (4, 4), (4, 4), (0, 0)), "edge")
    parts = [brush, picked] + [
        around[:, 4 + y : 4 + y + SIDE, 4 + x : 4 + x + SIDE] for y, x in mixing.PLACES
    ]
    found = space(found)
    return max((found - np.max(parts, 0)).max(), (np.min(parts, 0) - found).max())


def test_no_color_comes_out_that_did_not_go_in():
    rng = np.random.default_rng(0)
    inputs = inputs_like(rng)
    assert in_hull(mix(logits_like(rng), inputs), inputs) < 1e-4
    # A network that paints the color itself leaves the hull at once.
    _, variables, run = network(False, inputs.shape[-1])
    assert in_hull(run(variables, inputs), inputs) > 0.3


def test_white_on_white_stays_white_for_100_strokes_and_drifts_without_mixing():
    rng = np.random.default_rng(1)
    white = np.asarray(2.0 * to_srgb(jnp.asarray([0.9, 0.9, 0.88])) - 1.0)
    drift = {}
    for mixes in (True, False):
        inputs = inputs_like(rng).at[..., : mixing.COLORS].set(np.tile(white, (1, SIDE, SIDE, 3)))
        _, variables, run = network(mixes, inputs.shape[-1])
        for _ in range(100):
            inputs = inputs.at[..., :3].set(run(variables, inputs))
        drift[mixes] = float(np.abs(np.asarray(inputs[..., :3]) - white).max()) * 127.5
    print("off white after 100 strokes [of 255]:", drift)
    assert drift[True] < 0.1 < 10.0 < drift[False]


def test_shares_do_not_depend_on_colors_so_other_colors_give_the_same_painting():
    rng = np.random.default_rng(2)
    inputs = inputs_like(rng)
    _, variables, run = network(True, inputs.shape[-1])
    found = run(variables, inputs)
    paint = [2, 0, 1], jnp.asarray([0.6, 1.5, 1.0])[None, None, None, None]
    other = inputs.at[..., : mixing.COLORS].set(recolored(inputs[..., : mixing.COLORS], *paint))
    assert np.abs(other - inputs).max() > 0.1
    np.testing.assert_allclose(run(variables, other), recolored(found, *paint), atol=1e-4)


def test_two_paints_mix_as_the_simulators_pigments_do():
    rng = np.random.default_rng(3)
    inputs = inputs_like(rng)
    logits = jnp.full((1, SIDE, SIDE, mixing.PAINTS), -1e9)
    share = rng.uniform(0.05, 0.95, (SIDE, SIDE))
    middle = 2 + mixing.PLACES.index((0, 0))
    logits = logits.at[0, :, :, 0].set(np.log(share)).at[0, :, :, middle].set(np.log(1.0 - share))
    found = np.asarray(mix(logits, inputs))[0]
    colors = from_srgb(0.5 * (inputs[0] + 1.0))
    for y, x in ((0, 0), (3, 9), (15, 7)):
        palette = jnp.stack([colors[y, x, 3:6], colors[y, x, :3]])
        shares = jnp.asarray([share[y, x], 1.0 - share[y, x]], jnp.float32)
        want = 2.0 * to_srgb(mix_subtractive(shares, palette)) - 1.0
        np.testing.assert_allclose(found[y, x], want, atol=2e-4)


def seen(paints, height):
    """What the simulator's canvas shows of two pigments, volumes [mm], in sRGB of [-1, 1]."""
    layer, palette = 0.0625, jnp.asarray([[0.9, 0.25, 0.02], [0.02, 0.08, 0.4]])
    share = jnp.asarray(paints, jnp.float32) / sum(paints)
    levels = np.clip(height / layer - np.arange(20), 0.0, 1.0)
    paint = jnp.asarray(levels, jnp.float32)[:, None, None, None] * share[None, :, None, None]
    return 2.0 * to_srgb(flatten(paint, layer, palette, mixing="subtractive").color[0, 0]) - 1.0


@pytest.mark.parametrize("before", [0.0, 0.004, 0.05, 0.4])
@pytest.mark.parametrize("after", [0.005, 0.03, 0.1, 0.6])
def test_thin_films_look_as_the_simulators(before, after):
    """Half of each paint over canvas; a mixture with the ground itself is off by up to a tenth."""
    old, brush, want = seen((0.0, 1.0), before), seen((1.0, 0.0), 5.0), seen((0.5, 0.5), after)
    if before == 0.0:
        old = 2.0 * to_srgb(jnp.asarray(LINEN)) - 1.0
        want = seen((1.0, 0.0), after)
    inputs = jnp.concatenate([old, brush, brush, network_height(jnp.asarray([0.0, before, after]))])
    inputs = jnp.broadcast_to(inputs, (1, 4, 4, len(inputs)))
    logits = jnp.full((1, 4, 4, mixing.PAINTS), -1e9).at[..., 0].set(0.0)
    if before > 0.03:
        logits = logits.at[..., 2 + mixing.PLACES.index((0, 0))].set(0.0)
        np.testing.assert_allclose(mix(logits, inputs)[0, 1, 1], want, atol=2e-3)
    elif before == 0.0:
        np.testing.assert_allclose(mix(logits, inputs)[0, 1, 1], want, atol=2e-3)
        # The mixture that comes nearest, of brush and ground.
        share = np.linspace(0.0, 1.0, 101)[:, None]
        ends = [absorbed(from_srgb(0.5 * (c + 1.0)))[None] for c in (brush, old)]
        naive = 2.0 * to_srgb(reflected(share * ends[0] + (1.0 - share) * ends[1])) - 1.0
        off = np.abs(np.asarray(naive) - np.asarray(want)).max(1).min()
        assert off > 0.1 or after != 0.03
    # What is not touched looks as it did.
    still = jnp.full((1, 4, 4, mixing.PAINTS), -1e9)
    still = still.at[..., 2 + mixing.PLACES.index((0, 0))].set(0.0)
    same = inputs.at[..., -1].set(inputs[..., mixing.BEFORE])
    np.testing.assert_allclose(mix(still, same)[0, 1, 1], old, atol=2e-3)


def test_bare_canvas_of_any_ground_stays_and_shows_through():
    """Also one that is not linen; and where there is no paint no share can color it."""
    rng = np.random.default_rng(8)
    inputs = inputs_like(rng).at[..., [mixing.BEFORE, -1]].set(-1.0)
    np.testing.assert_allclose(mix(logits_like(rng), inputs), inputs[..., :3], atol=1e-4)
    # Through a film of the brush's paint.
    film, brush = 0.02, jnp.full((1, SIDE, SIDE, mixing.PAINTS), -1e9).at[..., 0].set(0.0)
    inputs = inputs.at[..., -1].set(network_height(film))
    ground, paint = (from_srgb(0.5 * (inputs[..., k : k + 3] + 1.0)) for k in (0, 3))
    want = paint + np.exp(-film / OPACITY) * (ground - paint)
    np.testing.assert_allclose(mix(brush, inputs), 2.0 * to_srgb(want) - 1.0, atol=2e-3)


def test_each_share_shows_its_own_paint():
    rng = np.random.default_rng(4)
    inputs = inputs_like(rng)
    canvas = np.pad(np.asarray(inputs[0, ..., :3]), ((4, 4), (4, 4), (0, 0)), "edge")
    for k in range(mixing.PAINTS):
        logits = jnp.full((1, SIDE, SIDE, mixing.PAINTS), -1e9).at[..., k].set(0.0)
        found = mix(logits, inputs)[0]
        if k < 2:
            want = inputs[0, ..., 3 * (k + 1) : 3 * (k + 2)]
        else:
            y, x = mixing.PLACES[k - 2]
            want = canvas[4 + y : 4 + y + SIDE, 4 + x : 4 + x + SIDE]
        np.testing.assert_allclose(found, want, atol=2e-4)


@pytest.mark.parametrize("color", [-1.0, -0.999, 0.0, 0.999, 1.0])
def test_slopes_are_finite_for_black_and_white(color):
    rng = np.random.default_rng(5)
    inputs = inputs_like(rng).at[..., : mixing.COLORS].set(color)
    slopes = jax.jit(jax.grad(lambda a, b: jnp.sum(plain(a, b)), (0, 1)))
    for height in (0.5, -0.96, -1.0):
        there = inputs.at[..., mixing.BEFORE].set(height).at[..., -1].set(height)
        for slope in slopes(logits_like(rng), there):
            assert np.all(np.isfinite(slope))


def test_slopes_are_true():
    rng = np.random.default_rng(6)
    inputs, logits = inputs_like(rng), logits_like(rng, 1.0)
    way = jnp.asarray(rng.normal(size=logits.shape), jnp.float32)
    error = jax.jit(lambda t: jnp.mean(plain(logits + t * way, inputs) ** 2))
    slope = float(jax.grad(error)(0.0))
    step = 1e-2
    assert (float(error(step)) - float(error(-step))) / (2 * step) == pytest.approx(slope, rel=0.02)


def test_compiled_equals_op_by_op_and_batched_equals_alone():
    rng = np.random.default_rng(7)
    two = [(logits_like(rng), inputs_like(rng)) for _ in range(2)]
    logits, inputs = (jnp.concatenate(x) for x in zip(*two, strict=True))
    found = mix(logits, inputs)
    np.testing.assert_allclose(found, plain(logits, inputs), atol=1e-5)
    np.testing.assert_allclose(found, jnp.concatenate([mix(*x) for x in two]), atol=1e-5)


def test_the_space_of_mixing_is_its_own_inverse():
    color = jnp.linspace(1e-3, 0.999, 200)
    np.testing.assert_allclose(reflected(absorbed(color)), color, atol=2e-4)


def test_a_network_that_mixes_is_a_color_network():
    with pytest.raises(ValueError, match="mixes with outputs = 1"):
        GeneratorConfig(outputs=1, mixes=True)
    config, variables, _ = network(True, 15)
    assert inputs_of(config, variables["params"]) == 15
    assert variables["params"]["encode1"]["kernel"].shape[2] == 15 - mixing.COLORS
    assert variables["params"]["decode4"]["kernel"].shape[3] == mixing.PAINTS


def test_one_network_for_color_and_height_mixes_the_color_alone():
    rng = np.random.default_rng(9)
    inputs = inputs_like(rng)
    run = Generator(GeneratorConfig(outputs=4, width=0.05, norm="none", mixes=True))
    variables = run.init(jax.random.key(0), inputs)
    found = run.apply(variables, inputs)
    assert variables["params"]["decode4"]["kernel"].shape[3] == mixing.PAINTS + 1
    paint = [1, 2, 0], jnp.asarray([0.7, 1.4, 1.0])[None, None, None, None]
    other = inputs.at[..., : mixing.COLORS].set(recolored(inputs[..., : mixing.COLORS], *paint))
    again = run.apply(variables, other)
    np.testing.assert_allclose(again[..., :3], recolored(found[..., :3], *paint), atol=1e-4)
    np.testing.assert_array_equal(again[..., 3], found[..., 3])


def test_low_precision_keeps_white_white():
    """Only convolutions are in bfloat16; the mixture is not."""
    white = 0.8
    rng = np.random.default_rng(8)
    inputs = inputs_like(rng).at[..., : mixing.COLORS].set(white)
    config = GeneratorConfig(outputs=3, width=0.05, norm="none", mixes=True, dtype="bfloat16")
    run = Generator(config)
    variables = run.init(jax.random.key(0), inputs)
    found = jax.jit(functools.partial(run.apply, variables))(inputs)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, white, atol=1e-4)
