import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import nnls

from jaxbrush import metrics as m

# Sharma, Wu, Dalal 2005, table 1: two Lab colors and CIEDE2000.
SHARMA = """
50 2.6772 -79.7751 50 0 -82.7485 2.0425|50 3.1571 -77.2803 50 0 -82.7485 2.8615
50 2.8361 -74.0200 50 0 -82.7485 3.4412|50 -1.3802 -84.2814 50 0 -82.7485 1.0000
50 -1.1848 -84.8006 50 0 -82.7485 1.0000|50 -0.9009 -85.5211 50 0 -82.7485 1.0000
50 0 0 50 -1 2 2.3669|50 -1 2 50 0 0 2.3669
50 2.49 -0.001 50 -2.49 0.0009 7.1792|50 2.49 -0.001 50 -2.49 0.0010 7.1792
50 2.49 -0.001 50 -2.49 0.0011 7.2195|50 2.49 -0.001 50 -2.49 0.0012 7.2195
50 -0.001 2.49 50 0.0009 -2.49 4.8045|50 -0.001 2.49 50 0.0010 -2.49 4.8045
50 -0.001 2.49 50 0.0011 -2.49 4.7461|50 2.5 0 50 0 -2.5 4.3065
50 2.5 0 73 25 -18 27.1492|50 2.5 0 61 -5 29 22.8977
50 2.5 0 56 -27 -3 31.9030|50 2.5 0 58 24 15 19.4535
50 2.5 0 50 3.1736 0.5854 1.0000|50 2.5 0 50 3.2972 0 1.0000
50 2.5 0 50 1.8634 0.5757 1.0000|50 2.5 0 50 3.2592 0.3350 1.0000
60.2574 -34.0099 36.2677 60.4626 -34.1751 39.4387 1.2644
63.0109 -31.0961 -5.8663 62.8187 -29.7946 -4.0864 1.2630
61.2901 3.7196 -5.3901 61.4292 2.2480 -4.9620 1.8731
35.0831 -44.1164 3.7933 35.0232 -40.0716 1.5901 1.8645
22.7233 20.0904 -46.6940 23.0331 14.9730 -42.5619 2.0373
36.4612 47.8580 18.3852 36.2715 50.5065 21.2231 1.4146
90.8027 -2.0831 1.4410 91.1528 -1.6435 0.0447 1.4441
90.9257 -0.5406 -0.9208 88.6381 -0.8985 -0.7239 1.5381
6.7747 -0.2908 -2.4247 5.8714 -0.0985 -2.2286 0.6377
2.0776 0.0795 -1.1350 0.9033 -0.0636 -0.5514 0.9082
"""


def noise(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def test_mask_chooses_and_scales_are_a_factor_of_two():
    true = noise(8, 12, 3)
    mask = jnp.zeros((8, 12, 1)).at[2:5, 3:9].set(1.0)
    found = true + jnp.where(mask > 0.0, 0.5, 9.0)
    assert float(m.rmse(found, true, mask)) == pytest.approx(0.5, rel=1e-6)
    assert float(m.mae(found, true, mask[..., 0])) == pytest.approx(0.5, rel=1e-6)
    inside, outside = 18 / 96, 78 / 96
    whole = np.sqrt(inside * 0.25 + outside * 81.0)
    assert float(m.rmse(found, true)) == pytest.approx(whole, rel=1e-6)
    scaled = m.rmse(m.image_scale(found), m.image_scale(true), mask)
    assert float(scaled) == pytest.approx(0.25, rel=1e-6)


def test_empty_mask_and_equal_pictures_give_zero_with_finite_slopes():
    true, empty = noise(8, 8), jnp.zeros((8, 8))
    for mask in (empty, None):
        value, slope = jax.jit(jax.value_and_grad(m.rmse))(true, true, mask)
        assert float(value) == 0.0 and bool(jnp.all(slope == 0.0))
    assert float(m.volume_bias(true, empty)) == 0.0
    angles = jax.jit(jax.grad(lambda h: jnp.sum(m.normal_angles(h, true, 0.1))))(true)
    assert bool(jnp.isfinite(angles).all())


def test_volume_bias_is_a_signed_share():
    true = jnp.full((4, 4), 0.2)
    assert float(m.volume_bias(true * 1.1, true)) == pytest.approx(0.1, rel=1e-5)
    assert float(m.volume_bias(true * 0.7, true, jnp.ones((4, 4)))) == pytest.approx(-0.3)


def test_normal_angle_of_two_planes():
    x = jnp.arange(8, dtype=jnp.float32)[None] * 0.1 * jnp.ones((8, 1))
    angles = m.normal_angles(x, jnp.zeros((8, 8)), 0.1)
    np.testing.assert_allclose(angles, 45.0, rtol=1e-5)
    small = m.normal_angles(1e-4 * x, jnp.zeros((8, 8)), 0.1)
    np.testing.assert_allclose(small, np.degrees(np.arctan(1e-4)), rtol=1e-4)


@pytest.mark.parametrize(("wavelength", "octave"), [(2.0, 0), (3.2, 0), (6.0, 1), (12.0, 2)])
def test_a_wave_is_in_its_octave(wavelength, octave):
    wave = jnp.cos(2 * jnp.pi * jnp.arange(64.0) / wavelength)[None] * jnp.ones((64, 1)) + 5.0
    power = m.octave_power(wave.astype(jnp.float32))
    assert power.shape == (5,)
    assert float(power[octave]) > 0.95 * float(power.sum())


def test_spectrum_ratio_tells_blur_from_noise():
    true = noise(64, 64)
    octaves = jax.jit(m.octave_power)
    blurred = sum(jnp.roll(true, (i, j), (0, 1)) for i in (0, 1) for j in (0, 1)) / 4
    power = octaves(true)
    blur = m.spectrum_ratio(octaves(blurred), power)
    grain = m.spectrum_ratio(octaves(true + noise(64, 64, seed=1)), power)
    assert float(blur[0]) < 0.4 < 0.9 < float(blur[3])
    assert float(grain[0]) == pytest.approx(2.0, rel=0.1)
    flat = octaves(jnp.ones((64, 64)))
    np.testing.assert_allclose(m.spectrum_ratio(flat, flat), 1.0)


def test_ciede2000_is_the_published_one(x64):
    rows = SHARMA.replace("|", "\n").split("\n")
    table = np.array([row.split() for row in rows if row], float)
    assert len(table) == 34
    found = m.ciede2000(jnp.asarray(table[:, :3]), jnp.asarray(table[:, 3:6]))
    np.testing.assert_allclose(found, table[:, 6], atol=5.1e-5)
    swapped = m.ciede2000(jnp.asarray(table[:, 3:6]), jnp.asarray(table[:, :3]))
    np.testing.assert_allclose(found, swapped, atol=1e-9)


def test_lab_of_known_colors_and_finite_slopes_at_black_and_equal():
    linear = jnp.array([[1.0, 1.0, 1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    known = [[100.0, 0.0, 0.0], [0.0, 0.0, 0.0], [53.24, 80.09, 67.20], [32.30, 79.19, -107.86]]
    np.testing.assert_allclose(m.lab(linear), known, atol=0.02)
    picture = linear.reshape(2, 2, 3)
    summed = jax.jit(jax.value_and_grad(lambda x: jnp.sum(m.delta_e(x, picture))))
    assert float(summed(picture)[0]) < 1e-6
    for x in (picture, 0.5 * picture):
        assert bool(jnp.isfinite(summed(x)[1]).all())


@pytest.mark.parametrize("count", [1, 2, 4, 12])
def test_hull_distance_is_that_of_least_squares(count):
    rng = np.random.default_rng(count)
    vertices = rng.random((count, 3)).astype(np.float32)
    colors = rng.uniform(-0.2, 1.2, (100, 3)).astype(np.float32)
    # Weights at least 0 and, by a heavy row, of sum 1.
    heavy = 1e4
    system = np.vstack([vertices.T, heavy * np.ones(count)])
    exact = [nnls(system, np.append(color, heavy))[1] for color in colors]
    found = m.hull_distance(jnp.asarray(colors), jnp.asarray(vertices))
    np.testing.assert_allclose(found, exact, atol=3e-3)


def test_out_of_hull_counts_false_colors_only():
    red, blue, white = jnp.eye(3)[0], jnp.eye(3)[2], jnp.ones(3)
    palette = jnp.stack([red, blue, white])
    share = np.random.default_rng(0).dirichlet(np.ones(3), (8, 8))
    color = jnp.asarray(share, jnp.float32) @ palette
    assert float(m.out_of_hull(color, palette)) == 0.0
    green = color.at[:2].set(jnp.array([0.0, 1.0, 0.0]))
    assert float(m.out_of_hull(green, palette)) == pytest.approx(0.25)
    mask = jnp.zeros((8, 8)).at[:4].set(1.0)
    assert float(m.out_of_hull(green, palette, mask)) == pytest.approx(0.5)


def test_extremes_span_nearly_the_same_hull():
    colors = jax.random.uniform(jax.random.key(1), (2000, 3))
    few = m.extremes(colors)
    assert few.shape == (64, 3)
    rows = {tuple(row) for row in np.asarray(colors).tolist()}
    assert all(tuple(row) in rows for row in np.asarray(few).tolist())
    assert float(m.out_of_hull(colors.reshape(40, 50, 3), few, tolerance=0.06)) < 0.05


def test_vmap_is_a_loop():
    a, b = noise(3, 16, 16, 3), noise(3, 16, 16, 3, seed=1)
    for function in (jax.jit(m.rmse), jax.jit(m.delta_e)):
        a_, b_ = m.image_scale(jnp.tanh(a)), m.image_scale(jnp.tanh(b))
        loop = jnp.stack([function(x, y) for x, y in zip(a_, b_, strict=True)])
        np.testing.assert_allclose(jax.vmap(function)(a_, b_), loop, rtol=2e-5)
