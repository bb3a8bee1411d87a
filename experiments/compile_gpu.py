"""What would a GPU have to hold? Simulator, data and training at full size, compiled for a GPU
that need not be there.

XLA's own compiler for NVIDIA GPUs turns each stage into a program for one H200 and says how much
memory it works in. It needs NVIDIA's plugin for JAX (`pip install --no-deps jax-cuda12-plugin
jax-cuda12-pjrt`, both of the version of jaxlib), but no GPU, no driver and no CUDA libraries.
Nothing runs: times and numbers of a GPU are not among what this shows.

    python -m experiments.compile_gpu            # about two minutes
    python -m experiments.compile_gpu --quick    # small sizes, about a minute
"""

import os

# The plugin looks for CUDA's libraries, which only programs that run need.
os.environ.setdefault("JAX_SKIP_CUDA_CONSTRAINTS_CHECK", "1")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import dataclasses
import functools
import importlib
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax.experimental import topologies
from jax.sharding import SingleDeviceSharding
from rich.progress import track

from experiments.common import helped, print_table, results_folder, write_run
from jaxbrush import data, pairs
from jaxbrush.brush import BrushConfig, make_brush, rollout
from jaxbrush.models import DiscriminatorConfig, GeneratorConfig
from jaxbrush.paint import (
    empty_canvas,
    heightfield_config,
    heightfield_stroke,
    load_brush,
    make_params,
    paint_stroke,
    presets,
)
from jaxbrush.raster import make_grid, trajectory_maps
from jaxbrush.stylus import make_stroke, resample
from jaxbrush.train import Batch, TrainConfig, make_train
from jaxbrush.train import make_params as make_rates

TARGET = """
gpu_device_info {
  threads_per_block_limit: 1024 threads_per_warp: 32 shared_memory_per_block: 49152
  shared_memory_per_core: 233472 threads_per_core_limit: 2048 core_count: 132 fpus_per_core: 128
  block_dim_limit_x: 2147483647 block_dim_limit_y: 65535 block_dim_limit_z: 65535
  memory_bandwidth: 4800000000000 l2_cache_size: 52428800 clock_rate_ghz: 1.98
  device_memory_size: 151397597184 shared_memory_per_block_optin: 232448
  cuda_compute_capability { major: 9 minor: 0 }
  registers_per_core_limit: 65536 registers_per_block_limit: 65536
}
platform_name: "CUDA"
dnn_version_info { major: 9 minor: 10 patch: 0 }
device_description_str: "NVIDIA H200 141GB HBM3e"
"""
"""An H200, as XLA describes it (openxla/xla, xla/backends/gpu/target_config/specs/h200.txtpb)."""


@dataclasses.dataclass(frozen=True)
class Config:
    """Memory of every stage on a GPU, from its compiler."""

    out: Path | None = None
    """Folder for the numbers [default: results/compile_gpu]."""
    quick: bool = False
    """Small sizes: the same code in about a minute."""
    batch: int = 8
    """Pairs an update sees."""


def gpu():
    """The device to compile for.

    Raises:
      SystemExit: no plugin, or one that cannot compile without a GPU; says what to install.
    """
    try:
        importlib.import_module("jax_plugins.xla_cuda12")
    except ImportError as error:
        raise SystemExit(
            "jax_plugins.xla_cuda12 is not installed: expected NVIDIA's plugin for JAX, `pip "
            f"install --no-deps jax-cuda12-plugin=={jax.__version__} "
            f"jax-cuda12-pjrt=={jax.__version__}`"
        ) from error
    try:
        found = topologies.get_topology_desc(
            platform="cuda", topology_name="1x1x1", topology="1x1x1", target_config=TARGET
        )
    except (RuntimeError, NotImplementedError) as error:
        raise SystemExit(f"jax {jax.__version__} cannot compile without a GPU: {error}") from error
    return found.devices[0]


def _shapes(tree):
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)), tree)


def compiled(device, function, *args) -> dict:
    """Compiles a function for arguments of these shapes: seconds, MB of arguments and of working
    memory, how many kernels and calls of libraries, and loops."""
    there = SingleDeviceSharding(device)
    shapes = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=there), _shapes(args)
    )
    start = time.perf_counter()
    program = jax.jit(function).lower(*shapes).compile()
    seconds = time.perf_counter() - start
    memory, text = program.memory_analysis(), program.as_text()
    return {
        "seconds": seconds,
        "arguments": memory.argument_size_in_bytes / 1e6,
        "working": memory.temp_size_in_bytes / 1e6,
        "kernels": text.count(" fusion(") + text.count(" custom-call("),
        "loops": text.count(" while("),
    }


def painting(quick: bool):
    """Name to (function, arguments) of what paints one stroke."""
    bristles, size = (16, 64) if quick else (presets.REAL, 512)
    stroke = make_stroke(np.linspace([4.0, 4.0], [0.1 * size, 6.0], 32))
    stroke = resample(stroke, 32 if quick else 1024, 0.0625, np.inf, depth=5.0)
    brush = make_brush(jax.random.key(0), BrushConfig(), "flat", bristles, width=4.5, length=20.0)
    moved = functools.partial(rollout, BrushConfig())
    track_ = jax.eval_shape(moved, brush, stroke)
    stages = {"bristles": (moved, (brush, stroke))}
    grid = make_grid((size, size), pixel=0.125)
    stages["maps"] = (functools.partial(trajectory_maps, grid), (track_,))
    mix = jnp.asarray([1.0, 0.0])
    for name in ("offline", "realtime"):
        config, params, _ = getattr(presets, name)()
        config = dataclasses.replace(config, pigments=2)
        dipped = load_brush(config, params, bristles, 0.8, mix)
        args = (params, empty_canvas(config, (size, size)), dipped, track_)
        stages[f"simulator, {name}"] = (functools.partial(paint_stroke, config), args)
    config = heightfield_config(pigments=2)
    dipped = load_brush(config, make_params(), bristles, 0.8, mix)
    args = (make_params(), empty_canvas(config, (size, size)), dipped, track_)
    stages["two films"] = (functools.partial(heightfield_stroke, config), args)
    return stages


def canvases(quick: bool):
    """Name to (function, arguments): a shard of the data set, its canvases side by side."""
    chosen = data.PRESETS["tiny" if quick else "paper"]
    options, count = chosen.pairs, chosen.shard
    shape = (options.size + 2 * pairs.MARGIN,) * 2
    key = jax.random.key(0)
    one = pairs.draw(options, key), pairs.draw_palette(key, options.paint.pigments), jnp.zeros(())
    given = _shapes((*one, empty_canvas(options.paint, shape)))
    given = jax.tree.map(lambda x: jax.ShapeDtypeStruct((count, *x.shape), x.dtype), given)
    function = functools.partial(jax.vmap(pairs.paint_pair, in_axes=(None, 0, 0, 0, 0)), options)
    return {f"{count} canvases of {options.size} px": (function, given)}


def training(quick: bool, batch: int):
    """Name to (function, arguments): an update of the paper's networks."""
    size, width = (64, 0.25) if quick else (512, 1.0)
    stages = {}
    for dtype in ("float32", "bfloat16"):
        config = TrainConfig(
            GeneratorConfig(width=width, dtype=dtype),
            DiscriminatorConfig(width, "instance", dtype), True,
        )  # fmt: skip
        init, update = make_train(config)
        picture = lambda c: jnp.zeros((batch, size, size, c))  # noqa: E731
        pictures = Batch(picture(6), picture(1), picture(1))
        state = jax.eval_shape(init, jax.random.key(0), pictures, make_rates())
        stages[f"update, {batch} x {size} px, {dtype}"] = (update, (state, pictures))
    return stages


def main(options: Config) -> list[dict]:
    device = gpu()
    stages = (
        painting(options.quick) | canvases(options.quick) | training(options.quick, options.batch)
    )
    rows = []
    for name, (function, args) in track(stages.items(), "compiling"):
        rows.append({"stage": name, **compiled(device, function, *args)})
    folder = results_folder("compile_gpu", options.out)
    write_run(folder, options, {"target": str(device.device_kind), "stages": rows})
    columns = ["stage", "to compile [s]", "arguments [MB]", "working [MB]", "kernels", "loops"]
    print_table(
        f"Compiled for {device.device_kind}",
        columns,
        [[r["stage"], f"{r['seconds']:.1f}", f"{r['arguments']:.1f}", f"{r['working']:.1f}",
          r["kernels"], r["loops"]] for r in rows],
    )  # fmt: skip
    return rows


if __name__ == "__main__":
    main(tyro.cli(Config, description=helped(__doc__)))
