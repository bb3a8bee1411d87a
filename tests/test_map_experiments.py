"""The experiments on trajectory maps run, and what they write makes sense."""

import json
import math

import cv2
import pytest

from experiments import map_accuracy, map_cases, show_maps

TINY = dict(strokes=("dab",), bristles=32, stamps=24)


def _metrics(folder):
    return json.loads((folder / "metrics.json").read_text())


def _check(folder, capsys):
    metrics = _metrics(folder)
    points = {p["name"]: p for p in metrics["points"]}
    coverage, outline, pressure, time = points["exact, pixel 0.1 mm"]["error"]
    assert 0.0 < coverage < 25.0 and outline < 20.0 and pressure < 50.0 and time < 20.0
    assert coverage < points["exact, pixel 0.2 mm"]["error"][0]
    assert all(p["maps"] > 0.0 and math.isfinite(p["joint"]) for p in points.values())
    assert metrics["floor"]["flops"] > 0 and metrics["parts"]["all maps"]["low"] > 0.0
    assert cv2.imread(str(folder / "accuracy.png")).shape[0] > 300
    assert "Bar" in capsys.readouterr().out


@pytest.mark.slow
def test_accuracy(tmp_path, capsys, monkeypatch):
    # Without what would be compiled for its time alone, and with a coarser reference.
    draw, roll = map_accuracy.draw, map_accuracy.roll
    monkeypatch.setattr(
        map_accuracy,
        "paint",
        lambda config, params, stroke, grid: draw(grid, roll(config, params, stroke)),
    )
    monkeypatch.setattr(
        map_accuracy,
        "parts",
        lambda case, params: {
            "bristles (rollout)": lambda: roll(map_accuracy.BrushConfig(), params, case["stroke"]),
            "all maps": lambda: draw(case["grid"], case["track"]),
            "bristles and maps in one": lambda: draw(case["grid"], case["track"]),
        },
    )
    monkeypatch.setattr(map_accuracy, "between", lambda track, times: track)
    monkeypatch.setattr(map_accuracy, "FINE", 2)
    every = map_accuracy.settings
    monkeypatch.setattr(map_accuracy, "settings", lambda options: every(options)[:2])
    monkeypatch.setattr(map_accuracy, "peak_flops", lambda: 1e11)
    monkeypatch.setattr(map_accuracy, "stream_bytes", lambda: 1e10)
    map_accuracy.main(map_accuracy.Config(out=tmp_path, rounds=1, families=("exact",), **TINY))
    _check(tmp_path, capsys)


@pytest.mark.slow
def test_accuracy_of_all(tmp_path, capsys):
    map_accuracy.main(map_accuracy.Config(out=tmp_path, rounds=1, **TINY))
    _check(tmp_path, capsys)
    assert len(_metrics(tmp_path)["points"]) == 14


def test_pictures(tmp_path, capsys):
    show_maps.main(show_maps.Config(out=tmp_path, zoom=1, **TINY))
    metrics = _metrics(tmp_path)
    dab = metrics["strokes"]["dab"]
    assert dab["touched"] > 500 and 0.0 < dab["pressure"] < 5.0 and dab["sweeps"] >= 1.0
    # A light stroke presses less, and the count of sweeps does not tell as much.
    shares = metrics["light_over_heavy"]
    assert 0.0 < shares["pressure"] < shares["sweeps"] < 1.0
    sheet = cv2.imread(str(tmp_path / "maps.png"))
    assert sheet.shape[1] > 5 * map_cases.SIDE and sheet.std() > 5.0
    assert cv2.imread(str(tmp_path / "pressure_sweeps.png")) is not None
    assert "light stroke" in capsys.readouterr().out
