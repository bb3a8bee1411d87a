"""A stroke's path and pressure come back from its maps (experiments/fit_stroke.py)."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import fit_stroke as f
from jaxbrush.brush import BrushConfig


def _level(**change):
    small = dict(path=(1.0, 0.5), press=(0.3, 0.1), steps=45)
    return dataclasses.replace(f.LEVELS[0], **small | change)


SMALL = f.Setting(brush=BrushConfig(nodes=4, approach=2, stride=1), scales=(6, 10))
FEW = (_level(), _level(weights=(0.5, 1.0), rate=(0.1, 0.02), path=(0.7, 0.7), steps=30))
OPTIONS = f.Config(shape="flat", bristles=10, stamps=40, extent=14.0, distance=2.0)


@pytest.fixture(scope="module")
def case():
    return f.make_case(SMALL, OPTIONS, 1)


@pytest.fixture(scope="module")
def tools():
    return f.make_tools(SMALL, FEW)


def test_basis_is_a_partition_of_one_and_keeps_lines():
    b = f.basis(33, 9)
    np.testing.assert_allclose(b.sum(1), 1.0, atol=1e-12)
    line = b @ np.arange(9.0)
    np.testing.assert_allclose(np.diff(line, 2), 0.0, atol=1e-12)


def test_start_has_the_path_asked_for(case):
    start = f.start_at(case.true.position, 0.4, SMALL.scales)
    found = f.stroke_of(start, case.true)
    assert f.errors(found, case.true)["path"] < 0.1
    np.testing.assert_allclose(found.pressure, 0.4, atol=1e-5)
    away = f.astray(jax.random.key(3), case.true, 2.0)
    off = np.linalg.norm(away - np.asarray(case.true.position), axis=1)
    pressed = np.asarray(case.true.pressure) > f.PRESSED
    assert np.sqrt(np.mean(off[pressed] ** 2)) == pytest.approx(2.0)


def test_target_is_what_a_level_compares(case):
    """Averages over pixels keep the coverage, and so does the sum over parts of the time."""
    target = f.target_of(dataclasses.replace(FEW[0], blur=0.0), case.exact)
    np.testing.assert_allclose(target.images[0].mean(), case.exact.coverage.mean(), rtol=1e-5)
    area = target.moments[:, 3].sum()
    np.testing.assert_allclose(area, case.exact.coverage.sum() * f.PIXEL**2, rtol=1e-4)


def test_loss_of_the_start_has_a_finite_slope(case, tools):
    target = f.target_of(FEW[-1], case.exact)
    drawn = tools.draw(case.start, case.true, case.brush)
    (loss, whole), slope = tools.slope(0.8, 0.8, case.origin, target, drawn)
    assert bool(whole) and float(loss) > 0.1
    for x in slope:
        assert bool(jnp.isfinite(x).all()) and float(jnp.abs(x).max()) > 0.0


@pytest.mark.slow
def test_small_fit_comes_three_times_closer_with_finite_slopes(case, tools):
    losses = []

    found = f.fit(tools, FEW, case, lambda unknown, loss, whole: losses.append(float(loss)))
    before = f.errors(f.stroke_of(case.start, case.true), case.true)
    after = f.errors(f.stroke_of(found, case.true), case.true)
    assert np.isfinite(losses).all()
    assert before["path"] == pytest.approx(2.0, abs=0.05)
    assert after["path"] < before["path"] / 3.0
    assert after["press"] < before["press"]

    target = f.target_of(FEW[-1], case.exact)
    drawn = tools.draw(case.start, case.true, case.brush)
    level = FEW[-1]
    _, slope = tools.slope(level.pixel, level.edge, case.origin, target, drawn)
    still = jax.tree.map(jnp.ones_like, case.start)
    memory = tools.optimizer.init(case.start)
    *_, gradient = tools.move(case.start, memory, case.true, case.brush, slope, still)
    assert all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(gradient))
    assert all(float(jnp.abs(x).max()) > 0.0 for x in jax.tree.leaves(gradient))


@pytest.mark.slow
def test_one_stroke_is_found_to_half_a_pixel():
    setting = f.Setting()
    case = f.make_case(setting, f.Config(), 1)
    tools = f.make_tools(setting, f.LEVELS)
    found = f.fit(tools, f.LEVELS, case)
    start = f.errors(f.stroke_of(case.start, case.true), case.true)
    end = f.errors(f.stroke_of(found, case.true), case.true)
    assert start["path"] == pytest.approx(3.0, abs=0.05)
    assert end["path"] < f.BAR
    assert end["press"] < 0.02
