"""Training pairs: what they hold, and that no damage to a data set goes unnoticed."""

import dataclasses
import json
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import evaluate, make_dataset, train_network
from jaxbrush import batches, checkpoint, data, pairs
from jaxbrush.canvas import flatten, from_srgb, to_srgb
from jaxbrush.models import Generator, GeneratorConfig
from jaxbrush.paint import PaintConfig, empty_canvas
from jaxbrush.painter import HEIGHT_INPUTS
from jaxbrush.train import Batch

SMALL = pairs.PairConfig(
    size=48, strokes=2, stamps=48, bristles=24,
    paint=PaintConfig(window=32, layers=8, pigments=3, samples=2, sweeps=1, viscous=2, pressure=4),
)  # fmt: skip
OPTIONS = data.DataConfig(SMALL, train=2, test=1, shard=1)
SEED = 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = data.start(tmp_path_factory.mktemp("data"), OPTIONS, SEED)
    for number in range(OPTIONS.shards):
        data.make_shard(path, OPTIONS, SEED, number)
    return path


@pytest.fixture
def copy(folder, tmp_path):
    for file in folder.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    return tmp_path


def test_a_pair_depends_on_its_seed_and_number_only(folder):
    found = data.load(folder)
    alone = pairs.canvas_pairs(SMALL, SEED, 1)[1]
    stored = found.take("train", [3])
    for name, _ in data.CHANNELS:
        level = batches.LEVELS.get(name.removeprefix("new_"), 1.0)
        want = np.clip(getattr(alone, name), 0.0, level)
        np.testing.assert_allclose(np.squeeze(stored[name]), want, atol=0.51 * level / data.FULL)
    other = pairs.canvas_pairs(SMALL, SEED + 1, 1)[1]
    assert np.abs(other.new_height - alone.new_height).max() > 0.02


@pytest.mark.slow
def test_canvases_side_by_side_are_the_same_pairs(folder, tmp_path):
    """As a GPU makes them: the same maps and as much paint. Single grooves differ, as they do where
    a stroke is shifted by a nanometre."""
    apart = dataclasses.replace(OPTIONS, shard=2, test=2)
    path = data.start(tmp_path, apart, SEED)
    data.make_shard(path, apart, SEED, 0, together=True)
    found = data._unpack(np.load(data.shard_path(path, 0)))
    alone = data._unpack(np.concatenate([np.load(data.shard_path(folder, n)) for n in range(2)]))
    assert len(found["height"]) == 4
    for name in ("pressure", "sweeps", "trajectory", "time", "load", "mask"):
        # A hair may leave a pixel's border on the other side.
        assert np.mean(found[name] != alone[name]) < 2e-3, name
    for name in ("new_height", "new_color"):
        sums = [x[name].sum((1, 2, 3), dtype=np.float64) for x in (found, alone)]
        np.testing.assert_allclose(*sums, rtol=0.02, err_msg=name)
    apart = np.sqrt(np.mean((found["new_height"] - alone["new_height"]) ** 2))
    print("rms difference of heights [um]", 1e3 * apart)
    assert apart < 0.1 * np.sqrt(np.mean(alone["new_height"] ** 2))


def test_as_many_processes_as_cores_or_one_for_the_accelerator(monkeypatch):
    answer = lambda name: types.SimpleNamespace(stdout=f"a warning\n{name}\n")  # noqa: E731
    monkeypatch.setattr(make_dataset.subprocess, "run", lambda *_, **__: answer("cpu"))
    assert make_dataset.processes_of(0, 8, 100) == 8 and make_dataset.processes_of(0, 8, 3) == 3
    monkeypatch.setattr(make_dataset.subprocess, "run", lambda *_, **__: answer("gpu"))
    assert make_dataset.processes_of(0, 8, 100) == 1 and make_dataset.processes_of(2, 8, 100) == 2


def test_a_stroke_changes_its_mask_and_is_the_next_background(folder):
    found = data.load(folder)
    assert (found.count("train"), found.count("test")) == (4, 2)
    p = found.take("train", [0, 1])
    changed = np.abs(p["new_height"] - p["height"])
    assert changed.max() > 0.03
    # Paint on the sides of a bristle may reach a little further than its coat at the tip.
    assert (changed * (1.0 - p["mask"])).sum() < 0.01 * changed.sum()
    assert p["mask"].mean() < 0.9
    np.testing.assert_array_equal(p["new_height"][0], p["height"][1])
    # Compiled twice, and a step of what is stored apart at most.
    np.testing.assert_allclose(p["new_color"][0], p["color"][1], atol=1.5 / data.FULL)
    assert p["height"][0].max() == 0.0
    # Where no bristle came, the maps are empty.
    bare = p["mask"] == 0.0
    for name in ("pressure", "sweeps", "time", "load"):
        assert np.all(p[name][bare] == 0.0)


def check_colors(p, inputs):
    """A brush has its color beside its bristles too, and what it picked up where it did."""
    came = np.asarray(batches.touched(p))[..., 0]
    for k in range(len(came)):
        own = p["trajectory"][k][came[k]][0]
        everywhere = np.broadcast_to(2.0 * own - 1.0, (48, 48, 3))
        np.testing.assert_allclose(inputs[k, ..., 3:6], everywhere, atol=1e-4)
        some = p["lift"][k, ..., 0] > 0.0
        np.testing.assert_array_equal(inputs[k, ..., 6:9][~some], inputs[k, ..., 3:6][~some])
        np.testing.assert_allclose(inputs[k, ..., 6:9][some], 2.0 * p["picked"][k][some] - 1.0,
                                   atol=1e-6)  # fmt: skip
    # The first stroke found a bare canvas, the second one paint.
    assert p["lift"][0].max() == 0.0 or p["height"][0].max() > 0.0


def test_batches_are_in_network_scale(folder):
    p = data.load(folder).take("test", [0, 1])
    height = batches.height_batch(p)
    assert height.inputs.shape == (2, 48, 48, 9) and height.target.shape == (2, 48, 48, 1)
    color = batches.color_batch(p)
    assert color.inputs.shape == (2, 48, 48, 8) and color.target.shape == (2, 48, 48, 3)
    assert batches.color_batch(p, time=False, height=False).inputs.shape[-1] == 6
    alone = [batches.height_batch(p, hand) for hand in ("pressure", "sweeps")]
    np.testing.assert_array_equal(alone[0].inputs[..., 1], height.inputs[..., 1])
    np.testing.assert_array_equal(alone[1].inputs[..., 1], height.inputs[..., 2])
    np.testing.assert_array_equal(height.inputs[..., 3:4], batches.network_time(p["time"]))
    few = batches.height_batch(p, time=False, load=False, tip=False, film=False, hair=False)
    assert few.inputs.shape[-1] == 3
    # Above all hair where none came.
    high = np.asarray(height.inputs[..., 5:6])
    assert np.all(high[~np.asarray(batches.touched(p))] == 1.0) and high.min() < -0.5
    # The film is the canvas where no hair came, and more or less where some did.
    grown = p["film"] - p["height"]
    assert np.all(grown[p["mask"] == 0.0] == 0.0) and grown.max() > 0.1
    np.testing.assert_allclose(
        height.inputs[..., 6:7], batches.network_height(p["film"]), atol=1e-6
    )
    np.testing.assert_array_equal(height.inputs[..., 8:9], batches.network_thin(p["film"]))
    # Hair is only where it came, and some of it in the paint.
    hair = np.asarray(height.inputs[..., 7])
    assert np.all(p["hair"][p["mask"] == 0.0] == 0.0) and p["hair"].max() > 0.01
    assert hair.min() == -1.0 and hair.max() <= 1.0
    # One network for both is told what either is, but for the height that it is to predict.
    painted, mixes = batches.single_batch(p), batches.single_batch(p, True, "pressure", hair=False)
    np.testing.assert_array_equal(painted.inputs[..., 6:], height.inputs)
    np.testing.assert_array_equal(painted.target[..., :3], color.target)
    np.testing.assert_array_equal(painted.target[..., 3:], height.target)
    told = batches.height_batch(p, "pressure", hair=False).inputs
    np.testing.assert_array_equal(mixes.inputs[..., 10:], told)
    mixed = batches.color_batch(p, mixes=True)
    np.testing.assert_array_equal(mixes.inputs[..., :10], mixed.inputs[..., :10])
    assert mixed.inputs.shape[-1] == 15
    check_colors(p, np.asarray(mixed.inputs))
    # One load a stroke, where the brush came.
    for load, came in zip(p["load"], np.asarray(batches.touched(p)), strict=True):
        assert 0.05 <= load.max() <= 1.0 and np.ptp(load[came]) < 1e-4
    # The clock is the way of the brush: some millimetres.
    assert 1.0 < p["time"].max() < 10.0
    scaled = np.asarray(batches.network_time(jnp.asarray([0.0, 1.0, 2.0, 4.0, 64.0, 100.0])))
    assert scaled[0] == -1.0 and scaled[4] == scaled[5] == 1.0 and np.all(np.diff(scaled[:5]) > 0.0)
    np.testing.assert_array_equal(color.inputs[..., 6], batches.network_time(p["time"])[..., 0])
    # A film of 10 um is told from none on one scale of films, and hardly on the other.
    some = jnp.asarray([0.0, 0.01, 0.02, 0.3, 1.25, 2.0])
    thin, thick = np.asarray(batches.network_thin(some)), np.asarray(batches.network_height(some))
    assert thin[0] == -1.0 and thin[4] == thin[5] == 1.0 and np.all(np.diff(thin[:5]) > 0.1)
    assert thin[1] - thin[0] > 0.25 and thick[1] - thick[0] < 0.02
    with pytest.raises(ValueError, match="hand = 'left'"):
        batches.height_batch(p, "left")
    for batch in (height, color, painted, mixes, *alone):
        for x in jax.tree.leaves(batch):
            assert x.dtype == np.float32
            assert float(x.min()) >= -1.0 and float(x.max()) <= 1.0
    shown = batches.preview(p)
    same = (p["time"] == 0.0) & (p["pressure"] == 0.0)
    assert np.all(np.asarray(shown["new_height"])[same] == p["height"][same])


def test_an_interrupted_shard_is_made_again_the_same(copy):
    path = data.shard_path(copy, 1)
    before = path.read_bytes()
    # Killed before the shard was whole: no note of it.
    path.with_suffix(".json").unlink()
    path.write_bytes(before[:1000])
    with pytest.raises(data.DataError, match="shard-00001.json"):
        data.load(copy)
    data.make_shard(copy, OPTIONS, SEED, 1)
    assert path.read_bytes() == before
    data.load(copy)
    assert not list(copy.glob("*.partial*"))


@pytest.mark.parametrize("damage", ["truncated", "flipped", "foreign"])
def test_a_damaged_shard_is_named_and_refused(copy, damage):
    path = data.shard_path(copy, 2)
    raw = bytearray(path.read_bytes())
    if damage == "truncated":
        raw = raw[: len(raw) // 2]
    elif damage == "flipped":
        raw[-7] ^= 1
    if damage == "foreign":
        np.save(path, np.zeros((4, 15, 32, 32), np.uint16))
    else:
        path.write_bytes(raw)
    with pytest.raises(data.DataError, match="shard-00002"):
        data.load(copy)


def test_another_data_set_is_not_mixed_in(copy):
    with pytest.raises(data.DataError, match="seed"):
        data.start(copy, OPTIONS, SEED + 1)
    with pytest.raises(data.DataError, match="config"):
        data.start(copy, dataclasses.replace(OPTIONS, train=3), SEED)
    data.start(copy, OPTIONS, SEED)
    manifest = json.loads((copy / "manifest.json").read_text())
    (copy / "manifest.json").write_text(json.dumps(manifest | {"format": 99}))
    with pytest.raises(data.DataError, match="format 99"):
        data.load(copy)


def test_options_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="multiple of shard"):
        data.DataConfig(SMALL, train=3, test=2, shard=2)
    with pytest.raises(ValueError, match="multiple of 4"):
        dataclasses.replace(SMALL, size=50)
    with pytest.raises(ValueError, match="stamps"):
        dataclasses.replace(SMALL, stamps=2)
    for spacing in (0.0, 0.1, 0.25):
        with pytest.raises(ValueError, match=f"PairConfig.spacing = {spacing}"):
            dataclasses.replace(SMALL, spacing=spacing)
    with pytest.raises(ValueError, match="PairConfig.relief = 0.01"):
        dataclasses.replace(SMALL, relief=0.01)


def test_the_weave_of_a_canvas_is_in_what_is_painted_and_in_what_is_told():
    palette, _, plan = pairs._begun(SMALL, 0, 0)
    dry = dataclasses.replace(plan(0), load=jnp.asarray(0.2, float))
    bare = empty_canvas(SMALL.paint, (SMALL.size + 2 * pairs.MARGIN,) * 2)
    smooth, deep = (
        pairs._paint_pair(SMALL, dry, palette, jnp.asarray(relief, float), bare)[1]
        for relief in (0.03, 0.1)
    )
    for name in ("new_height", "film"):
        assert np.abs(getattr(smooth, name) - getattr(deep, name)).max() > 1e-3, name


def test_exported_networks_are_judged_on_any_data_set(folder, tmp_path, capsys):
    weights = []
    for kind, outputs, channels in (("height", 1, HEIGHT_INPUTS), ("color", 3, 15)):
        options = GeneratorConfig(outputs, width=0.05, mixes=kind == "color")
        variables = Generator(options).init(jax.random.key(0), np.zeros((1, 8, 8, channels)))
        weights.append(tmp_path / f"{kind}.npz")
        checkpoint.export(weights[-1], options, variables, {"command": "a test"})
    evaluate.main(evaluate.Config(tuple(weights), height=weights[0], data=folder, out=tmp_path))
    found = json.loads((tmp_path / "metrics.json").read_text())
    for path in weights:
        rows = found[str(path)]["errors"]
        assert rows["the simulator"]["rmse_masked"] == 0.0
        # A height network that has learned nothing paints gray; one that mixes cannot.
        if path == weights[0]:
            assert rows["the network"]["rmse_whole"] > rows["copy the background"]["rmse_whole"]
        assert (tmp_path / f"{path.stem}.png").stat().st_size > 500
    color = found[str(weights[1])]["errors"]
    assert color["on predicted height"]["delta_e"] != color["the network"]["delta_e"]
    assert "2 test pairs" in capsys.readouterr().out
    # One network for both is judged in its two parts.
    options = GeneratorConfig(4, width=0.05, mixes=True)
    variables = Generator(options).init(jax.random.key(0), np.zeros((1, 8, 8, 10 + HEIGHT_INPUTS)))
    single = tmp_path / "single.npz"
    checkpoint.export(single, options, variables, {})
    evaluate.main(evaluate.Config((single,), data=folder, out=tmp_path))
    parts = json.loads((tmp_path / "metrics.json").read_text())[str(single)]["errors"]
    for kind, path in zip(("height", "color"), weights, strict=True):
        alone = found[str(path)]["errors"]["copy the background"]
        assert parts[kind]["copy the background"]["rmse_masked"] == alone["rmse_masked"]
    with pytest.raises(SystemExit, match="no such weights: .*absent.npz"):
        evaluate.main(evaluate.Config((tmp_path / "absent.npz",), data=folder, out=tmp_path))
    options = GeneratorConfig(1, width=0.05)
    other = Generator(options).init(jax.random.key(0), np.zeros((1, 8, 8, 3)))
    checkpoint.export(tmp_path / "other.npz", options, other, {})
    with pytest.raises(SystemExit, match=f"of 3 inputs: expected {HEIGHT_INPUTS}"):
        evaluate.main(evaluate.Config((tmp_path / "other.npz",), data=folder, out=tmp_path))
    (tmp_path / "broken.npz").write_bytes(b"weights")
    with pytest.raises(SystemExit, match="broken.npz"):
        evaluate.main(evaluate.Config((tmp_path / "broken.npz",), data=folder, out=tmp_path))


def test_recolored_pairs_are_what_other_paint_would_have_given():
    rng = np.random.default_rng(0)
    paint = rng.uniform(0.1, 0.3, (6, 3, 16, 16)).astype(np.float32)
    palette = rng.uniform(0.03, 0.9, (3, 3)).astype(np.float32)
    channels, scale = np.array([2, 0, 1]), np.array([1.7, 0.6, 1.0], np.float32)

    def seen(palette):
        thick = flatten(jnp.asarray(paint), 0.1, jnp.asarray(palette), mixing="subtractive")
        return 2.0 * to_srgb(thick.color) - 1.0

    def change(bright):
        ratio = scale * (1.0 - bright) ** 2 / (2.0 * bright)
        return (1.0 + ratio - np.sqrt(ratio**2 + 2.0 * ratio))[:, channels]

    target = seen(palette)[None]
    stroke = target.at[:, :4].set(-1.0)  # no stroke there
    rest = jnp.zeros((1, 16, 16, 2))
    batch = Batch(jnp.concatenate([target, stroke, rest], -1), target, rest[..., :1])
    found = batches.recolored(batch, jnp.asarray(channels, jnp.int32), jnp.asarray(scale))
    want = seen(change(palette))[None]
    np.testing.assert_allclose(found.target, want, atol=1e-3)
    np.testing.assert_allclose(found.inputs[..., :3], want, atol=1e-3)
    np.testing.assert_array_equal(found.inputs[:, :4, :, 3:6], -1.0)
    np.testing.assert_allclose(found.inputs[:, 4:, :, 3:6], want[:, 4:], atol=1e-3)
    np.testing.assert_array_equal(found.inputs[..., 6:], rest)
    # The naive way, the same factor on linear RGB, is not what that paint gives.
    naive = 2.0 * to_srgb(scale * np.asarray(from_srgb(0.5 * (target + 1.0)))) - 1.0
    same = seen(np.clip(scale * palette, 0.0, 1.0))[None]
    assert np.abs(naive - same).max() > 0.05
    nothing = batches.recolored(batch, jnp.arange(3, dtype=jnp.int32), jnp.ones(3))
    np.testing.assert_allclose(nothing.inputs, batch.inputs, atol=2e-3)
    np.testing.assert_array_equal(nothing.mask, batch.mask)


def test_no_test_stroke_is_a_training_stroke_of_another_set(folder):
    found = data.load(folder)
    alone = pairs.canvas_pairs(SMALL, SEED, OPTIONS.train)[0]  # the next training canvas
    stored = found.take("test", [0])
    assert np.abs(stored["new_height"][0, ..., 0] - alone.new_height).max() > 0.02


def test_predicted_heights_are_laid_as_in_use(folder):
    found = data.load(folder)
    config = GeneratorConfig(outputs=1, width=0.05)
    variables = Generator(config).init(jax.random.key(0), jnp.zeros((1, 48, 48, HEIGHT_INPUTS)))
    network = checkpoint.Exported(variables, config, {})
    index = np.arange(found.count("train"))
    heights = train_network.predicted_heights(found, "train", index, network)
    raw = found.take("train", index)
    cover = np.asarray(batches.touched(raw))
    # Where bristles came it is the network's, far from them the canvas as it was.
    assert np.abs(heights - raw["new_height"])[cover].max() > 0.1
    np.testing.assert_array_equal(heights[raw["mask"] == 0.0], raw["height"][raw["mask"] == 0.0])


def test_color_is_taught_on_true_and_on_predicted_heights(folder):
    found = data.load(folder)
    options = train_network.Config()
    index = np.arange(1, found.count("train"))
    laid = np.random.default_rng(0).uniform(0.0, 1.0, (len(index), 48, 48, 1)).astype(np.float32)
    both = train_network.Stored(found, index, "color", options, laid)
    once = train_network.Stored(found, index, "color", options)
    assert len(both) == 2 * len(once) == 2 * len(index)
    first, again = both.take([1]), both.take([1 + len(index)])
    np.testing.assert_array_equal(first.inputs, once.take([1]).inputs)
    np.testing.assert_array_equal(again.inputs[..., :-1], first.inputs[..., :-1])
    np.testing.assert_array_equal(again.target, first.target)
    np.testing.assert_allclose(again.inputs[..., -1:], batches.network_height(laid[1:2]), atol=1e-6)


def test_heights_to_follow_are_checked_before_work_starts(tmp_path):
    def run(kind, **changes):
        train_network.main(kind, train_network.Config(data=tmp_path / "set", **changes))

    with pytest.raises(SystemExit, match="--laid .*none.npz: no such file"):
        run("color", laid=tmp_path / "none.npz")
    with pytest.raises(SystemExit, match="expected with train_color"):
        run("height", laid=evaluate.SHIPPED / "height.npz")
    with pytest.raises(SystemExit, match="expected a height network"):
        run("color", laid=evaluate.SHIPPED / "color.npz")
    assert not (tmp_path / "set").exists()
