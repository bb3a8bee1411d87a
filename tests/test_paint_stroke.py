"""Whole strokes of paint, small: conservation, what is not touched, what was never loaded."""

import jax.numpy as jnp
import numpy as np
import pytest
from paint_cases import BRISTLES, SIDE, brush_of, held, params_of, pulled, stroke

from jaxbrush.paint import (
    PaintConfig,
    empty_canvas,
    height,
    load_brush,
    make_params,
    paint_stroke,
    volume,
)

CONFIG = PaintConfig(layers=8, window=24, pigments=2, samples=2, sweeps=1, viscous=3, pressure=4)


def paint(load=0.8, mix=(1.0, 0.0), canvas=None, **where):
    canvas = empty_canvas(CONFIG, (SIDE, SIDE)) if canvas is None else canvas
    brush = brush_of(load, mix)
    return brush, *stroke(CONFIG, params_of(), canvas, brush, pulled(**where))


def test_a_stroke_conserves_every_pigment():
    before, canvas, brush, report = paint(mix=(0.7, 0.3))
    laid = np.asarray(volume(CONFIG, canvas), np.float64)
    assert laid.sum() > 0.5
    np.testing.assert_allclose(laid + held(brush), held(before), rtol=1e-6)
    assert float(canvas.min()) >= 0.0
    assert bool(report.reached.all())
    assert float(report.fullest.max()) < 1.0 + 1e-4
    assert np.all(np.isfinite(np.asarray(report.residual)))


def test_white_stays_white_and_what_is_far_is_not_touched():
    _, first, _, _ = paint(y=2.0)
    _, canvas, _, _ = paint(canvas=first, y=4.4)
    # The second pigment was never loaded.
    assert np.all(np.asarray(canvas[:, 1]) == 0.0)
    changed = np.any(np.asarray(canvas != first), axis=(0, 1))
    rows = np.nonzero(changed.any(1))[0] * CONFIG.pixel
    # Bristles reach from 3.65 to 5.15 mm; the yield radius is about 6 cells.
    assert rows.min() > 3.65 - 8 * CONFIG.pixel
    assert height(CONFIG, canvas)[10:20].max() > 0.05


def test_dirty_canvas_smears_only_downstream():
    band = empty_canvas(CONFIG, (SIDE, SIDE)).at[:3, 1, :, 28:34].set(1.0)
    before, canvas, brush, _ = paint(load=0.3, canvas=band)
    total = np.asarray(volume(CONFIG, band), np.float64) + held(before)
    now = np.asarray(volume(CONFIG, canvas), np.float64) + held(brush)
    np.testing.assert_allclose(now, total, rtol=1e-6)
    second = np.asarray(canvas[:, 1]).sum((0, 1))
    # The flow may push the band's own edge by some cells; the brush carries none upstream.
    assert np.all(second[:20] == 0.0)
    assert second[38:].sum() > 0.0
    assert float(brush.tip[1].sum()) > 0.0


def test_an_empty_brush_on_a_bare_canvas_does_nothing():
    _, canvas, brush, _ = paint(load=0.0)
    assert np.all(np.asarray(canvas) == 0.0)
    assert np.all(held(brush) == 0.0)


def test_a_brush_in_the_air_leaves_the_canvas_alone():
    _, first, _, _ = paint(y=3.0)
    # Where the hair last was, the paint closes once it is gone; then nothing moves any more.
    _, settled, _, _ = paint(canvas=first, low=2.0)
    _, canvas, _, _ = paint(canvas=settled, low=2.0)
    assert float(jnp.abs(height(CONFIG, settled) - height(CONFIG, first)).max()) < 1e-6
    assert np.array_equal(np.asarray(canvas), np.asarray(settled))


def test_padding_and_edges():
    # Half the brush over the edge, the rest of the stroke padding.
    brush, canvas, wet, _ = paint(y=0.3, start=0.2, valid=10)
    total = float(volume(CONFIG, canvas).sum()) + held(wet).sum()
    assert total == pytest.approx(held(brush).sum(), rel=1e-6)
    assert np.all(np.asarray(canvas)[..., 30:] == 0.0)
    assert np.all(np.isfinite(np.asarray(canvas)))


def test_shapes_that_do_not_fit_are_refused():
    params = make_params()
    brush = load_brush(CONFIG, params, BRISTLES, 1.0, jnp.asarray([1.0, 0.0]))
    with pytest.raises(ValueError, match="canvas has shape"):
        paint_stroke(CONFIG, params, jnp.zeros((4, 2, SIDE, SIDE)), brush, pulled())
    with pytest.raises(ValueError, match="brush.tip"):
        few = load_brush(CONFIG, params, 3, 1.0, jnp.asarray([1.0, 0.0]))
        paint_stroke(CONFIG, params, empty_canvas(CONFIG, (SIDE, SIDE)), few, pulled())
    with pytest.raises(ValueError, match="window"):
        empty_canvas(CONFIG, (8, 56))
    with pytest.raises(ValueError, match="solver"):
        PaintConfig(solver="magic")
    with pytest.raises(ValueError, match="gravity"):
        make_params(gravity=9.81)
