"""The ablation sweep: variants trained alike, charted, and not trained twice."""

import json

import pytest

from experiments import ablations, single_or_twins
from experiments.single_or_twins import ALONE
from jaxbrush import data, pairs
from jaxbrush.paint import PaintConfig

SMALL = pairs.PairConfig(
    size=32, strokes=2, stamps=16, bristles=8,
    paint=PaintConfig(window=24, layers=4, pigments=2, samples=1, sweeps=1, viscous=2, pressure=2),
)  # fmt: skip
OPTIONS = data.DataConfig(SMALL, train=3, test=1, shard=1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = data.start(tmp_path_factory.mktemp("data"), OPTIONS, 0)
    for number in range(OPTIONS.shards):
        data.make_shard(path, OPTIONS, 0, number)
    return path


@pytest.mark.slow
def test_variants_are_trained_once_and_charted(folder, tmp_path, capsys):
    given = dict(kind="height", data=folder, out=tmp_path, quick=True)
    only = ("width 1/8", "the paper's maps")
    ablations.main(ablations.Config(only=only, **given))
    rows = {r["name"]: r for r in json.loads((tmp_path / "metrics.json").read_text())["rows"]}
    assert set(rows) == set(only)
    for row in rows.values():
        assert row["steps"] == 20 and 0.0 < row["masked"] < 2.0 and row["ms"] > 0.0
    assert (tmp_path / "ablations.png").stat().st_size > 5000
    assert json.loads((tmp_path / "width 1_8" / "config.json").read_text())["width"] == 0.125
    weights = tmp_path / "width 1_8" / "height.npz"
    before = weights.stat().st_mtime_ns
    ablations.main(ablations.Config(only=only, **given))
    assert weights.stat().st_mtime_ns == before
    with pytest.raises(SystemExit, match="trained in another way"):
        ablations.main(ablations.Config(only=only, **given | {"quick": False, "steps": 30}))
    with pytest.raises(SystemExit, match="--only nothing: expected names among default"):
        ablations.main(ablations.Config(only=("nothing",), **given))


@pytest.mark.parametrize("kind", ["height", "color"])
def test_every_variant_is_something_that_training_knows(kind, tmp_path):
    options = ablations.Config(kind=kind)
    ways = [
        ablations.options_of(options, tmp_path, name, changes)
        for name, changes in ablations.chosen(options).items()
    ]
    assert len({way.out for way in ways}) == len(ways) > 8
    assert all(way.steps == options.steps and way.minutes is None for way in ways)


@pytest.mark.slow
def test_one_network_is_compared_with_two(folder, tmp_path, capsys):
    single_or_twins.main(single_or_twins.Config(data=folder, out=tmp_path, quick=True))
    rows = {r["name"]: r for r in json.loads((tmp_path / "metrics.json").read_text())["rows"]}
    assert set(rows) == {"twins", "twins, painted"} | {n for n in ALONE if n.startswith("single")}
    assert all(0.0 < r["height"] < 2.0 and 0.0 < r["color"] < 2.0 for r in rows.values())
    # Twins share the height network, and differ in the color.
    assert rows["twins"]["height"] == rows["twins, painted"]["height"]
    assert rows["twins"]["color"] != rows["twins, painted"]["color"]
    for name in ("chart.png", "sheet.png"):
        assert (tmp_path / name).stat().st_size > 5000
