"""Every stage becomes a program for GPU and TPU too, on a machine that has none.

`jax.export` writes one program for all platforms: what has no rule on one of them is an error
there, and calls of libraries, which differ from platform to platform, are found in the program.
"""

import dataclasses
import functools
import importlib.util
import json
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

from jaxbrush import painter, pairs, stages
from jaxbrush.brush import BrushConfig, make_brush, rollout
from jaxbrush.brush.shapes import INTEGRATORS
from jaxbrush.canvas import blank
from jaxbrush.models import DiscriminatorConfig, Generator, GeneratorConfig
from jaxbrush.paint import (
    PaintConfig,
    empty_canvas,
    heightfield_config,
    heightfield_stroke,
    load_brush,
    make_params,
    paint_stroke,
)
from jaxbrush.paint.state import SOLVERS
from jaxbrush.raster import make_grid, trajectory_maps
from jaxbrush.stylus import make_stroke
from jaxbrush.train import Batch, TrainConfig, make_train
from jaxbrush.train import make_params as make_rates

PLATFORMS = ("cpu", "cuda", "tpu")
STROKE = jax.tree.map(jnp.asarray, make_stroke(np.linspace([1.0, 2.0], [6.0, 3.0], 12)))
BRUSH = make_brush(jax.random.key(0), BrushConfig(), "flat", 6, width=1.0, length=5.0)


def lowers(function, *args):
    """Exports for all platforms; the library calls of the program."""
    found = export.export(jax.jit(function), platforms=PLATFORMS)(*args)
    assert found.platforms == PLATFORMS
    return set(re.findall(r"custom_call @([\w.]+)", found.mlir_module()))


@functools.cache
def moved():
    return jax.jit(rollout)(BrushConfig(), BRUSH, STROKE)


def test_calls_of_libraries_are_found():
    assert lowers(jnp.linalg.solve, jnp.eye(3), jnp.ones(3))
    host = lambda x: jax.pure_callback(np.sin, jax.ShapeDtypeStruct((), np.float32), x)  # noqa: E731
    with pytest.raises(NotImplementedError):
        lowers(host, jnp.float32(1.0))


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_brush(integrator):
    config = BrushConfig(integrator=integrator)
    slope = jax.grad(lambda brush, stroke: rollout(config, brush, stroke).force.sum())
    for function in (functools.partial(rollout, config), slope):
        calls = lowers(function, BRUSH, STROKE)
        # It factors one small matrix a stroke, by the library of each platform.
        assert not calls or (integrator == "projective" and any("cusolver" in c for c in calls))


@pytest.mark.parametrize("edge", [None, 0.2])
def test_maps(edge):
    grid = make_grid((32, 64), pixel=0.125)
    assert not lowers(lambda track: trajectory_maps(grid, track, edge=edge), moved())


@pytest.mark.parametrize("solver", SOLVERS)
def test_paint(solver):
    config = PaintConfig(layers=4, window=16, pigments=2, solver=solver, viscous=2, pressure=2)
    loaded = load_brush(config, make_params(), 6, 0.8, jnp.asarray([1.0, 0.0]))
    canvas = empty_canvas(config, (24, 64))
    run = functools.partial(paint_stroke, config)
    assert not lowers(run, make_params(), canvas, loaded, moved())


def test_heightfield():
    config = heightfield_config(window=16, pigments=2)
    loaded = load_brush(config, make_params(), 6, 0.8, jnp.asarray([1.0, 0.0]))
    run = functools.partial(heightfield_stroke, config)
    assert not lowers(run, make_params(), empty_canvas(config, (24, 64)), loaded, moved())


def test_pairs_side_by_side():
    grid = PaintConfig(layers=4, window=16, pigments=2, viscous=2, pressure=2)
    options = pairs.PairConfig(size=16, stamps=8, bristles=6, paint=grid)
    plans = [pairs.draw(options, key) for key in jax.random.split(jax.random.key(0))]
    shape = (options.size + 2 * pairs.MARGIN,) * 2
    both = lambda x: jnp.stack([x, x])  # noqa: E731
    run = functools.partial(jax.vmap(pairs.paint_pair, in_axes=(None, 0, 0, 0, 0)), options)
    given = jax.tree.map(lambda *x: jnp.stack(x), *plans), both(jnp.ones((2, 3)))
    assert not lowers(run, *given, jnp.full(2, 0.05), both(empty_canvas(grid, shape)))


def variables(config, inputs):
    sizes = jnp.zeros((1, 8, 8, inputs)), jnp.ones((1, 8, 8, 1))
    shapes = jax.eval_shape(Generator(config).init, jax.random.key(0), *sizes)
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)


@pytest.mark.parametrize("edge", [None, 0.25])
def test_painter(edge):
    configs = [GeneratorConfig(outputs=n, width=0.05, norm="none", mixes=n == 3) for n in (1, 3)]
    inputs = painter.HEIGHT_INPUTS, painter.MIXED_INPUTS
    nets = stages.Nets(*(variables(c, n) for c, n in zip(configs, inputs, strict=True)), *configs)
    options = painter.PainterConfig(edge=edge)
    sizes = stages.Sizes(stamps=16, sides=(64, 96))
    color, first = jnp.ones(3), jnp.zeros(2, jnp.int32)
    run = functools.partial(painter.paint_on, options, sizes)
    assert not lowers(run, nets, blank((64, 96)), BRUSH, color, STROKE, first)
    if edge is not None:

        def error(position):
            stroke = dataclasses.replace(STROKE, position=position)
            return run(nets, blank((64, 96)), BRUSH, color, stroke, first)[0].height.sum()

        assert not lowers(jax.grad(error), STROKE.position)


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_training(dtype):
    config = TrainConfig(
        GeneratorConfig(outputs=1, width=0.05, dtype=dtype),
        DiscriminatorConfig(0.05, "instance", dtype), True,
    )  # fmt: skip
    init, update = make_train(config)
    batch = Batch(
        inputs=jnp.zeros((1, 32, 32, 5)), target=jnp.zeros((1, 32, 32, 1)),
        mask=jnp.ones((1, 32, 32, 1)),
    )  # fmt: skip
    state = jax.eval_shape(init, jax.random.key(0), batch, make_rates())
    assert not lowers(update, state, batch)


def compile_gpu(*options):
    command = [sys.executable, "-m", "experiments.compile_gpu", *map(str, options)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_every_stage_compiles_for_a_gpu(tmp_path):
    pytest.importorskip("jax_plugins.xla_cuda12", reason="NVIDIA's plugin for JAX")
    done = compile_gpu("--quick", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    stages = json.loads((tmp_path / "metrics.json").read_text())["stages"]
    assert len(stages) == 8 and all(s["kernels"] > 0 for s in stages)
    # bfloat16 holds pictures in half the memory.
    full, half = (s["working"] for s in stages[-2:])
    assert half < 0.75 * full


def test_without_the_plugin_it_is_said_what_to_install(tmp_path):
    if importlib.util.find_spec("jax_plugins") is not None:
        pytest.skip("a plugin is installed")
    done = compile_gpu("--quick", "--out", tmp_path / "made")
    assert done.returncode == 1
    assert "pip install --no-deps jax-cuda12-plugin==" in done.stderr
    assert not (tmp_path / "made").exists()
