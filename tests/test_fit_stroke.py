"""A stroke's path and pressure come back from its maps (experiments/fit_stroke.py)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import fit_opening, fit_stroke
from experiments.fit_loss import PIXEL, Level, target_of
from jaxbrush.brush import BrushConfig

f = fit_stroke
SMALL = f.Setting(brush=BrushConfig(nodes=4, approach=2, stride=1), scales=(6, 10))
FEW = (Level(0.8, (1, 3), 30, (0.05, 0.02), (1.0, 0.7)),)
OPTIONS = f.Config(shape="flat", bristles=10, stamps=40, extent=14.0, distance=2.0)


@pytest.fixture(scope="module")
def case():
    return f.make_case(SMALL, OPTIONS, 1)


@pytest.fixture(scope="module")
def tools():
    return f.make_tools(SMALL, FEW)


def _stroke(case, curve):
    return f.with_curve(case.true, curve[:, :2], curve[:, 2])


def test_basis_is_a_partition_of_one_and_keeps_lines():
    b = fit_opening.basis(33, 9)
    np.testing.assert_allclose(b.sum(1), 1.0, atol=1e-12)
    line = b @ np.arange(9.0)
    np.testing.assert_allclose(np.diff(line, 2), 0.0, atol=1e-12)


def test_start_is_as_far_off_as_asked_for(case):
    path = f.astray(jax.random.key(3), case.true, 2.0)
    off = np.linalg.norm(path - np.asarray(case.true.position), axis=1)
    assert np.sqrt(np.mean(off**2)) == pytest.approx(2.0)
    stroke = _stroke(case, case.start)
    np.testing.assert_allclose(stroke.pressure, OPTIONS.pressure, atol=1e-5)
    assert f.errors(stroke, case)["path"] == pytest.approx(2.0, abs=0.3)


def test_control_points_make_the_curve(case):
    found = f.stroke_of(f.unknown_of(case.start, SMALL.scales), case.true)
    off = np.linalg.norm(np.asarray(found.position) - case.start[:, :2], axis=1)
    assert off.max() < 0.1
    np.testing.assert_allclose(found.pressure, OPTIONS.pressure, atol=1e-2)


def test_target_is_what_a_level_compares(case):
    """Averages over pixels keep the coverage, and so does the sum over parts of the time."""
    target = target_of(FEW[0], case.exact)
    np.testing.assert_allclose(target.images[0].mean(), case.exact.coverage.mean(), rtol=1e-5)
    area = fit_opening.moments(case.exact)[:, 3].sum()
    np.testing.assert_allclose(area, case.exact.coverage.sum() * PIXEL**2, rtol=1e-4)


def test_opening_comes_closer_and_stays_at_the_truth(case, tools):
    maps = lambda stroke: f.exact_maps(case.origin, tools.draw(stroke, case.brush))  # noqa: E731
    curve = case.start
    for _ in range(6):
        curve = fit_opening.moved(curve, maps(_stroke(case, curve)), case.exact)
    assert f.errors(_stroke(case, curve), case)["path"] < 0.4

    press = np.asarray(case.true.pressure, float).clip(1e-3, 1.0 - 1e-3)
    truth = np.concatenate([case.true.position, np.log(press / (1.0 - press))[:, None]], 1)
    still = fit_opening.moved(truth, maps(case.true), case.exact)
    assert f.errors(_stroke(case, still), case)["path"] < 0.1


def test_loss_has_a_finite_slope_and_is_least_at_the_truth(case, tools):
    target = target_of(FEW[-1], case.exact)
    drawn = tools.draw(_stroke(case, case.start), case.brush)
    (loss, whole), slope = tools.slope(0.8, case.origin, target, drawn)
    assert bool(whole) and float(loss) > 0.1
    for x in slope:
        assert bool(jnp.isfinite(x).all()) and float(jnp.abs(x).max()) > 0.0
    (least, _), _ = tools.slope(0.8, case.origin, target, tools.draw(case.true, case.brush))
    assert float(least) < 1e-2


@pytest.mark.slow
def test_small_fit_comes_closer_with_finite_slopes(case, tools):
    losses = []
    watch = lambda stroke, loss, whole: losses.append(loss)  # noqa: E731
    found = f.fit(SMALL, tools, FEW, case, watch, again=0)
    losses = np.asarray(losses[f.OPENING :], float)
    before, after = f.errors(_stroke(case, case.start), case), f.errors(found, case)
    assert np.isfinite(losses).all()
    assert losses[-1] < losses[0]
    assert after["path"] < before["path"] / 8.0
    assert after["press"] < before["press"] / 2.0
    # A second descent, from near by, is kept only where its maps are more alike.
    target = target_of(FEW[-1], case.exact)
    unlike = lambda x: float(  # noqa: E731
        f.unlike_exact(f.exact_maps(case.origin, tools.draw(x, case.brush)), target)
    )
    ticks = []
    other = f.fit(SMALL, tools, FEW, case, again=1, tick=lambda: ticks.append(1))
    assert len(ticks) == sum(level.steps for level in FEW) and unlike(other) <= unlike(found)
    off = f.disturbed(np.random.default_rng(0), found, early=True)[:, :2] - found.position
    size = np.linalg.norm(off, axis=1)
    assert size[:10].mean() > 0.05 and size[-10:].max() < 0.01

    unknown = f.unknown_of(case.start, SMALL.scales)
    drawn = tools.draw(f.stroke_of(unknown, case.true), case.brush)
    _, slope = tools.slope(0.8, case.origin, target_of(FEW[-1], case.exact), drawn)
    still = jax.tree.map(jnp.ones_like, unknown)
    memory = tools.optimizer.init(unknown)
    *_, gradient = tools.move(unknown, memory, case.true, case.brush, slope, still)
    assert all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(gradient))
    assert all(float(jnp.abs(x).max()) > 0.0 for x in jax.tree.leaves(gradient))


@pytest.mark.slow
def test_one_stroke_is_found_to_half_a_pixel():
    setting = f.Setting()
    case = f.make_case(setting, f.Config(), 1)
    found = f.fit(setting, f.make_tools(setting, f.LEVELS), f.LEVELS, case)
    start, end = f.errors(_stroke(case, case.start), case), f.errors(found, case)
    assert start["path"] == pytest.approx(3.0, abs=0.1)
    assert end["path"] < f.BAR
    assert end["press"] < 0.02
