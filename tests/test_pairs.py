"""Strokes, brushes and canvases of training pairs, as they are drawn at random."""

import dataclasses

import jax
import numpy as np

from jaxbrush import pairs
from jaxbrush.paint import RELIEF


def test_long_strokes_fit_their_stamps():
    options = pairs.PairConfig()
    for k in range(12):
        plan = pairs.draw(options, jax.random.key(k))
        position = np.asarray(plan.stroke.position)[np.asarray(plan.stroke.valid)]
        step = np.hypot(*np.diff(position, axis=0).T)
        assert step.max() <= options.spacing * 1.01
        assert np.isclose(float(plan.mix.sum()), 1.0) and 0.0 < float(plan.load) <= 1.0


def test_canvases_and_brushes_are_such_that_some_strokes_catch_on_the_weave():
    options = pairs.PairConfig(beside=0)
    begun = [pairs._begun(options, 0, number) for number in range(60)]
    reliefs = np.asarray([float(relief) for _, relief, _ in begun])
    usual = reliefs == np.float32(RELIEF)
    assert 0.25 < usual.mean() < 0.75
    assert RELIEF < reliefs[~usual].min() and 0.08 < reliefs.max() <= options.relief
    loads = np.asarray([float(plan(0).load) for *_, plan in begun])
    assert 0.05 <= loads.min() and 0.05 < np.mean(loads < 0.25) < 0.3


def test_some_canvases_are_painted_side_by_side():
    """Strokes at random hardly ever run along the edge of another; a painter's do."""
    options = pairs.PairConfig()

    def paths(options, number):
        _, _, plan = pairs._begun(options, 0, number)
        plans = [plan(k) for k in range(options.strokes)]
        ends = []
        for p in plans:
            known = np.asarray(p.stroke.position)[np.asarray(p.stroke.valid)]
            assert np.hypot(*np.diff(known, axis=0).T).max() <= options.spacing * 1.01
            ends.append(known[[0, -1]])
        return plans, np.stack(ends), [np.asarray(p.stroke.pressure).max() for p in plans]

    def apart(ends):
        """Angles between neighbours as undirected lines, and how far aside their middles lie."""
        chord = ends[:, 1] - ends[:, 0]
        chord /= np.linalg.norm(chord, axis=1, keepdims=True)
        step = np.diff(ends.mean(1), axis=0)
        aside = np.abs(step[:, 1] * chord[:-1, 0] - step[:, 0] * chord[:-1, 1])
        return np.degrees(np.arccos(np.abs(np.sum(chord[1:] * chord[:-1], 1)).clip(0, 1))), aside

    for number in (2, 5, 8):
        plans, ends, press = paths(options, number)
        angles, aside = apart(ends)
        width = (4.0 * float(plans[0].brush.press_depth) - 6.0) / 3.0
        assert angles.max() < 10.0 and len(set(press)) == options.strokes
        assert 0.0 < aside.min() and aside.max() < 1.3 * width
        for p in plans[1:]:
            jax.tree.map(np.testing.assert_array_equal, p.brush, plans[0].brush)
        # At random they would not be like that, and others are as without.
        alone, ends, _ = paths(dataclasses.replace(options, beside=0), number)
        assert apart(ends)[0].max() > 20.0
        np.testing.assert_array_equal(alone[1].mix, plans[1].mix)
    none = dataclasses.replace(options, beside=0)
    for mine, its in zip(paths(options, 3)[0], paths(none, 3)[0], strict=True):
        jax.tree.map(np.testing.assert_array_equal, mine, its)


def test_most_strokes_side_by_side_are_pulled():
    """Handle leaning the way it goes, pressure steady: in about `PULLED` of those canvases, for all
    of their strokes, to and fro; where strokes are random hardly ever."""

    def pulled(options, number):
        _, _, plan = pairs._begun(options, 0, number)
        found = []
        for stroke in (plan(k).stroke for k in range(2)):
            known = np.asarray(stroke.valid)
            way = np.asarray(stroke.position)[known]
            chord = way[-1] - way[0]
            lean = np.asarray(stroke.azimuth)[known].mean() - np.arctan2(chord[1], chord[0])
            press = np.asarray(stroke.pressure)[known]
            found.append(np.cos(lean) > 0.8 and np.mean(press > 0.99 * press.max()) > 0.6)
        return found

    options = pairs.PairConfig()
    beside = [pulled(options, number) for number in range(2, 44, 3)]
    assert all(a == b for a, b in beside)
    assert 0.5 < np.mean(beside) < 0.95
    assert np.mean([pulled(options, number) for number in range(0, 24, 3)]) < 0.2


def test_a_third_of_the_strokes_side_by_side_are_dry():
    options = pairs.PairConfig()
    plans = [pairs._begun(options, 0, number)[2] for number in range(2, 62, 3)]
    loads = np.asarray([float(plan(k).load) for plan in plans for k in range(2)])
    assert 0.2 < np.mean(loads < 0.25) < 0.55 and loads.min() >= 0.05
