"""The training loop (experiments/training.py) and its report (experiments/evaluation.py)."""

import dataclasses
import json

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import evaluation, feed, training
from experiments.evaluation import Pairs, Scale
from experiments.training import Options
from jaxbrush import checkpoint
from jaxbrush.canvas import OPACITY
from jaxbrush.mixing import LEVEL
from jaxbrush.models import Generator
from jaxbrush.train import Batch

SCALE = Scale(height=1.0, pixel=0.2)
SMALL = Options(
    steps=4, minutes=None, width=0.03, discriminator_width=0.02, check_every=2, log_every=1
)
pytestmark = [
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]


def blurred(rng, count, side, sigma, amount):
    noise = rng.normal(size=(count, side, side)).astype(np.float32)
    smooth = np.stack([cv2.GaussianBlur(x, (0, 0), sigma) for x in noise])
    return np.clip(amount * smooth / smooth.std(), 0.0, 1.0)[..., None]


def toy(count, side=32, seed=0, kind="height"):
    """Paint is what the pressure map leaves, blurred, on top of what was there."""
    rng = np.random.default_rng(seed)
    background, pressure = (blurred(rng, count, side, s, 0.4) for s in (4.0, 3.0))
    laid = np.stack([cv2.GaussianBlur(x, (0, 0), 1.5)[..., None] for x in pressure])
    after = np.clip(background + 0.6 * laid, 0.0, 1.0)
    mask = (laid > 0.02).astype(np.float32)
    preview = np.clip(background + 0.3 * (pressure > 0.0), 0.0, 1.0).astype(np.float32)
    scaled = lambda x: 2.0 * x - 1.0  # noqa: E731
    inputs = np.concatenate([background, pressure], -1)
    if kind != "height":
        count = training.OUTPUTS[kind]
        inputs = np.concatenate([background.repeat(3, -1), laid.repeat(3, -1), pressure, after], -1)
        background, after, preview = (x.repeat(count, -1) for x in (background, after, preview))
    return Pairs(Batch(scaled(inputs), scaled(after), mask), scaled(background), scaled(preview))


def test_heights_are_taught_by_more_than_l1():
    height, color = (training.train_params(Options(), kind, 0.5) for kind in ("height", "color"))
    assert (float(height.l1), float(height.l2), float(height.opacity)) == (10.0, 200.0, 20.0)
    assert float(height.gradient) == 200.0
    assert float(color.l1) == 10.0 and float(color.l2) == 0.0
    assert float(height.generator_rate) == pytest.approx(0.5 * Options().rate)
    paper = training.train_params(Options(l2=0.0, opacity=0.0, gradient=0.0), "height")
    assert float(paper.l2) == float(paper.opacity) == float(paper.gradient) == 0.0


def test_every_pair_comes_once_an_epoch_and_order_is_a_function_of_the_step():
    count, size = 7, 3
    seen = np.concatenate([feed.indices(5, step, size, count) for step in range(7)])
    for epoch in range(3):
        assert sorted(seen[7 * epoch : 7 * epoch + 7]) == list(range(7))
    assert not np.array_equal(seen[:7], seen[7:14])
    np.testing.assert_array_equal(feed.indices(5, 4, size, count), seen[12:15])
    assert not np.array_equal(feed.indices(6, 4, size, count), seen[12:15])


def test_streamed_and_resident_pairs_give_the_same_batches():
    pairs = toy(5, side=8)
    options = dataclasses.replace(SMALL, batch=2, turns=False)
    resident = feed.make_batches(pairs, options)
    streamed = feed.make_batches(pairs, dataclasses.replace(options, resident=0.0))
    for step in (0, 3):
        (a, i), (b, j) = resident(step), streamed(step)
        np.testing.assert_array_equal(i, j)
        jax.tree.map(np.testing.assert_array_equal, a, b)
        np.testing.assert_array_equal(a.target, pairs.batch.target[i])


def test_pairs_are_brought_together_some_at_a_time():
    pairs = toy(2 * feed.SOME + 3, side=8)
    jax.tree.map(np.testing.assert_array_equal, feed.every(pairs), pairs.batch)


def test_color_pairs_are_recolored_by_the_number_of_the_step():
    pairs = toy(5, side=8, kind="color")
    options = dataclasses.replace(SMALL, turns=False)
    plain = feed.make_batches(pairs, options)(3)[0]
    make = feed.make_batches(pairs, dataclasses.replace(options, mixes=False), "color")
    first, again, other = make(3)[0], make(3)[0], make(8)[0]
    np.testing.assert_array_equal(first.target, again.target)
    assert np.abs(first.target - plain.target).max() > 0.01
    assert np.abs(first.target - other.target).max() > 0.01
    np.testing.assert_array_equal(first.inputs[..., 6:], plain.inputs[..., 6:])
    # One that mixes is not shown colors.
    mixing = feed.make_batches(pairs, options, "color")(3)[0]
    np.testing.assert_array_equal(mixing.target, plain.target)


def test_pairs_are_turned_in_eight_ways_all_maps_alike():
    pairs = toy(2, side=8)
    seen = set()
    for which in range(8):
        found = feed.turned(pairs.batch, which)
        # The target stays where its inputs are: paint was added to the background.
        inside = np.asarray(found.mask)[..., 0] == 0.0
        np.testing.assert_array_equal(
            np.asarray(found.target)[..., 0][inside]
            > np.asarray(found.inputs)[..., 0][inside] + 0.1,
            False,
        )
        assert np.asarray(found.inputs).sum() == pytest.approx(pairs.batch.inputs.sum(), rel=1e-5)
        seen.add(np.asarray(found.inputs).tobytes())
    assert len(seen) == 8
    batches = feed.make_batches(pairs, dataclasses.replace(SMALL, batch=1))
    first, again = batches(3)[0], batches(3)[0]
    np.testing.assert_array_equal(first.inputs, again.inputs)


def test_errors_of_known_pictures():
    pairs = toy(3, side=16)
    truth = np.asarray(pairs.batch.target)
    same = evaluation.errors("height", truth, pairs.batch, SCALE)
    assert max(same["rmse_whole"], same["normal_angle"], abs(same["volume_bias"])) < 1e-6
    np.testing.assert_allclose(same["spectrum"], 1.0)
    more = evaluation.errors("height", truth + 0.2, pairs.batch, SCALE)
    assert more["rmse_whole"] == pytest.approx(0.2, rel=1e-5)
    assert more["rmse_masked_image"] == pytest.approx(0.1, rel=1e-5)
    mask, mm = np.asarray(pairs.batch.mask), 0.5 * (truth + 1.0)
    assert more["volume_bias"] == pytest.approx(0.1 * mask.sum() / (mask * mm).sum(), rel=1e-4)
    assert more["normal_angle"] < 0.01
    through = 1.0 - np.exp(-0.2 * 0.5 * LEVEL / OPACITY)
    expected = through * (mask * np.exp(-mm * LEVEL / OPACITY)).sum() / mask.sum()
    assert same["light"] == 0.0 and more["light"] == pytest.approx(expected, rel=1e-3)


def test_color_errors_tell_false_colors():
    pairs = toy(2, side=64, kind="color")
    truth = np.asarray(pairs.batch.target)
    same = evaluation.errors("color", truth, pairs.batch, SCALE)
    # Everything here is gray; what lies in between is in the hull.
    assert same["delta_e"] < 1e-3 and same["out_of_hull"] < 0.1
    red = truth.copy()
    red[..., 0] = 1.0
    false = evaluation.errors("color", red, pairs.batch, SCALE)
    assert false["delta_e"] > 20.0 and false["out_of_hull"] > 0.9
    columns, rows = evaluation.table("color", {"x": same, "y": false})
    assert all(len(row) == len(columns) for row in rows)


def test_a_single_network_is_judged_in_its_two_parts():
    pairs = toy(2, side=16, kind="single")
    truth = np.asarray(pairs.batch.target)
    wrong = truth + np.array([0.0, 0.0, 0.0, 0.2], np.float32)
    parts = evaluation.parts("single", wrong, pairs)
    found = {name: evaluation.compare(name, *part, SCALE) for name, part in parts.items()}
    assert found["color"]["the network"]["rmse_whole"] == 0.0
    assert found["height"]["the network"]["rmse_whole"] == pytest.approx(0.2, rel=1e-5)
    alone = evaluation.compare("height", truth[..., 3:], toy(2, side=16), SCALE)
    assert found["height"]["copy the background"] == alone["copy the background"]
    assert evaluation.parts("height", truth, pairs) == {"height": (truth, pairs)}


@pytest.mark.slow
def test_a_single_network_learns_color_and_height(tmp_path):
    options = dataclasses.replace(SMALL, out=tmp_path, mixes=False, recolor=False)
    found = training.fit(options, "single", *(toy(4, 16, s, "single") for s in range(3)), SCALE)
    assert set(found["errors"]) == {"color", "height"}
    exported = checkpoint.load(tmp_path / "single.npz")
    assert exported.config.outputs == 4
    assert set(exported.card["errors of the preview stroke"]) == {"color", "height"}


def test_log_goes_on_from_a_checkpoint(tmp_path):
    path = tmp_path / "metrics.jsonl"
    log = training._Log(path, 2, 0)
    for step in range(6):
        log.add(step, {"l1": float(step)})
    log.file.write('{"step": 9, "l')  # as a killed run leaves it
    log.file.close()
    training._Log(path, 2, 4).file.close()
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert [(line["step"], line["l1"]) for line in lines] == [(1, 0.5), (3, 2.5)]


def test_no_budget_is_refused(tmp_path):
    options = dataclasses.replace(SMALL, steps=None)
    with pytest.raises(ValueError, match="steps = None, minutes = None"):
        training.run(options, "height", toy(2), toy(2), tmp_path)


@pytest.mark.slow
def test_a_training_may_start_from_exported_weights(tmp_path):
    """Of the same network they are taken as they are; moments are folded where norms differ."""
    pairs = toy(8)
    first = dataclasses.replace(SMALL, average=False, steps=2)
    config, state, _ = training.run(first, "height", pairs, toy(2, seed=1), tmp_path / "first")
    path = tmp_path / "height.npz"
    checkpoint.export(path, config.generator, {"params": state.generator}, {})
    held = toy(2, seed=1)
    found = {}
    for norm in ("instance", "none"):
        options = dataclasses.replace(SMALL, start=path, norm=norm, steps=1, rate=0.0)
        config, state, _ = training.run(options, "height", pairs, held, tmp_path / norm)
        variables = {"params": state.average}
        found[norm] = evaluation.paint(config.generator, variables, held.batch)
    exported = checkpoint.load(path)
    before = evaluation.paint(exported.config, exported.variables, held.batch)
    np.testing.assert_allclose(found["instance"], before, atol=1e-5)
    assert 0.0 < np.abs(found["none"] - before).mean() < 0.1 * np.abs(before).mean() + 0.02
    other = dataclasses.replace(SMALL, start=path, width=0.06)
    with pytest.raises(ValueError, match="is of another network: width: 0.03 saved, 0.06 given"):
        training.run(other, "height", pairs, held, tmp_path / "other")


@pytest.mark.slow
def test_fit_beats_half_of_copying_the_background(tmp_path):
    options = Options(out=tmp_path, steps=500, minutes=None, width=0.25, discriminator_width=0.25,
                      batch=4, rate=2e-3, discriminator_rate=5e-4, check_every=250)  # fmt: skip
    found = training.fit(options, "height", toy(64), toy(8, seed=1), toy(16, seed=2), SCALE)
    rows = found["errors"]
    ours = rows["the network"]["rmse_masked"]
    print(found["seconds"], {name: row["rmse_masked"] for name, row in rows.items()})
    assert ours < 0.5 * rows["copy the background"]["rmse_masked"]
    assert ours < rows["the preview stroke"]["rmse_masked"]
    assert json.loads((tmp_path / "metrics.json").read_text())["errors"] == rows
    assert (tmp_path / "samples.png").stat().st_size > 1000
    assert len(list((tmp_path / "samples").glob("*.png"))) == 2
    loaded = checkpoint.load(tmp_path / "height.npz")
    again = Generator(loaded.config).apply(loaded.variables, toy(16, seed=2).batch.inputs[:2])
    error = np.sqrt(np.mean((np.asarray(again) - toy(16, seed=2).batch.target[:2]) ** 2))
    assert error < 2.0 * rows["the network"]["rmse_whole"]


@pytest.mark.slow
def test_killed_run_resumes_to_the_same_bits(tmp_path, monkeypatch):
    train, held = toy(5, side=16), toy(2, side=16, seed=1)
    _, straight, _ = training.run(SMALL, "height", train, held, tmp_path / "a")

    def kill(*_):
        raise KeyboardInterrupt

    # Killed, not asked for fewer steps: the rates of a shorter run fall faster.
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(training, "sample_grid", kill)
        training.run(SMALL, "height", train, held, tmp_path / "b")
    with pytest.raises(ValueError, match="has checkpoints: resume them"):
        training.run(SMALL, "height", train, held, tmp_path / "b")
    on = dataclasses.replace(SMALL, resume=True)
    with pytest.raises(ValueError, match="seed: 0 saved, 1 given"):
        training.run(dataclasses.replace(on, seed=1), "height", train, held, tmp_path / "b")
    with pytest.raises(ValueError, match="checksum of the first pairs"):
        training.run(on, "height", toy(5, side=16, seed=2), held, tmp_path / "b")
    _, resumed, numbers = training.run(on, "height", train, held, tmp_path / "b")
    assert numbers["steps"] == 4 and int(resumed.step) == int(straight.step)
    jax.tree.map(np.testing.assert_array_equal, resumed, straight)
    a, b = ((tmp_path / name / "metrics.jsonl").read_text() for name in "ab")
    assert a == b


@pytest.mark.slow
def test_non_finite_step_stops_and_names_what_to_look_at(tmp_path):
    train, held = toy(6, side=16), toy(2, side=16, seed=1)
    order = [int(feed.indices(0, step, 1, 6)[0]) for step in range(6)]
    target = np.array(train.batch.target)
    target[order[3]] = np.nan
    batch = dataclasses.replace(train.batch, target=jnp.asarray(target))
    broken = dataclasses.replace(train, batch=batch)
    options = dataclasses.replace(SMALL, steps=6)
    with pytest.raises(training.NotFinite, match=rf"step 3 .* pairs \[{order[3]}\].*checkpoints/2"):
        training.run(options, "height", broken, held, tmp_path)
