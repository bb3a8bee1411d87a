"""Sessions turned into deeds for the three engines, and what the commands refuse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import compare_engines, engines, paint_scenes, paint_session
from jaxbrush import checkpoint, recordings
from jaxbrush.canvas import Canvas, blank, mix_subtractive
from jaxbrush.models import Generator, GeneratorConfig
from jaxbrush.painter import COLOR_INPUTS, HEIGHT_INPUTS

PALETTE = np.asarray(list(paint_scenes.PALETTE.values()))


def test_shares_of_a_mixture_are_found_again():
    rng = np.random.default_rng(0)
    for _ in range(20):
        true = rng.dirichlet(np.full(len(PALETTE), 0.5))
        rgb = np.asarray(mix_subtractive(true.astype(np.float32), PALETTE.astype(np.float32)))
        found = engines.shares(rgb, PALETTE)
        assert found.min() >= 0.0 and abs(found.sum() - 1.0) < 1e-6
        again = mix_subtractive(found.astype(np.float32), PALETTE.astype(np.float32))
        np.testing.assert_allclose(again, rgb, atol=2e-3)
    for k in range(len(PALETTE)):
        assert engines.shares(PALETTE[k], PALETTE)[k] > 0.98


def test_the_picture_that_comes_along_is_a_session_and_fills_its_canvas():
    session = paint_scenes.recorded("sea")
    strokes = [e for e in session.events if isinstance(e, recordings.StrokeEvent)]
    assert len(strokes) == 34
    deeds = engines.deeds_of(session, (132, 176))
    assert len(deeds) == 34
    with pytest.raises(ValueError, match="relief = -0.1"):
        engines.make("realtime", (132, 176), deeds, relief=-0.1)
    place = np.concatenate([np.asarray(d.stroke.position) for d in deeds])
    # Half the pixels: half the size.
    assert np.abs(place.max(0) - 0.5 * np.asarray([43.0, 31.0])).max() < 1.0
    assert len(engines.palette_of(deeds)) == 6
    assert {d.load for d in deeds} == {d for d in np.asarray([t.load for t in paint_scenes._sea()])}


def test_engines_are_compared_in_colors_that_the_palette_mixes():
    deeds = engines.deeds_of(paint_scenes.recorded("sea"), (132, 176))
    palette = engines.palette_of(deeds)

    def apart(deeds):
        """From what the simulator's pigments give for the colors of the deeds."""
        given = [
            mix_subtractive(engines.shares(d.color, palette).astype(np.float32), palette)
            for d in deeds
        ]
        return np.abs(np.asarray(given) - np.asarray([d.color for d in deeds])).max()

    mixable = engines.mixable(deeds)
    assert apart(mixable) < 2e-3 < 0.02 < apart(deeds)
    np.testing.assert_allclose(engines.palette_of(mixable), palette, atol=1e-5)


def test_a_session_without_brush_and_color_is_painted_all_the_same():
    stroke = recordings.StrokeEvent((0.0, 1.0), (1.0, 5.0), (1.0, 2.0), (0.5, 0.5))
    session = recordings.Session((8.0, 8.0), 1.0, (stroke,) * 3)
    deeds = engines.deeds_of(session, (64, 64))
    assert len({d.color for d in deeds}) == 3
    brush = recordings.BrushEvent({"width": 2.0, "colour": 1.0})
    with pytest.raises(ValueError, match="brush event: colour: expected"):
        engines.deeds_of(recordings.Session((8.0, 8.0), 1.0, (brush, stroke)), (64, 64))


def test_errors_count_where_either_painted():
    true = blank((8, 8))
    found = Canvas(true.height.at[2:4].set(0.1), true.color)
    error = compare_engines.errors(found, true)
    assert error["height"] == pytest.approx(100.0) and error["color"] == 0.0


def test_what_is_missing_is_named_before_work_begins(tmp_path):
    absent = (tmp_path / "height.npz", tmp_path / "color.npz")
    with pytest.raises(SystemExit, match="height.npz"):
        paint_session.main(paint_session.Config(weights=absent, out=tmp_path))
    bad = tmp_path / "bad.jsonl"
    bad.write_text('{"format": "other"}\n')
    with pytest.raises(SystemExit, match="bad.jsonl:1: format"):
        paint_session.main(paint_session.Config(recording=bad, out=tmp_path))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bad.jsonl"]


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["neural", "realtime"])
def test_a_recording_is_painted(engine, tmp_path):
    weights = []
    for kind, outputs, channels in (("height", 1, HEIGHT_INPUTS), ("color", 3, COLOR_INPUTS)):
        options = GeneratorConfig(outputs, width=0.05)
        variables = Generator(options).init(jax.random.key(0), jnp.zeros((1, 8, 8, channels)))
        weights.append(tmp_path / f"{kind}.npz")
        checkpoint.export(weights[-1], options, variables, {})
    brush = recordings.BrushEvent({"width": 2.0, "length": 12.0, "depth": 3.0, "bristles": 16})
    stroke = recordings.StrokeEvent(
        t=(0.0, 0.05, 0.1), x=(2.0, 4.0, 6.0), y=(4.0, 4.5, 4.0), pressure=(0.1, 0.5, 0.1)
    )
    recordings.write(
        tmp_path / "s.jsonl", recordings.Session((8.0, 8.0), 1.0, (brush, stroke, stroke))
    )
    out = tmp_path / "out"
    paint_session.main(paint_session.Config(
        recording=tmp_path / "s.jsonl", engine=engine, weights=tuple(weights), out=out
    ))  # fmt: skip
    names = {"color.png", "height.png", "lit.png", "timelapse.gif", "session.jsonl",
             "config.json", "metrics.json"}  # fmt: skip
    assert {p.name for p in out.iterdir()} == names
