"""What a brush step must cost at least, and what other code takes for it."""

import re
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from experiments import brush_lanes, brush_numba
from experiments.brush_cases import STAMP, roll, single, stroke_of
from experiments.common import Timing, timed
from jaxbrush.brush import BrushConfig
from jaxbrush.brush.handle import poses
from jaxbrush.brush.rollout import solved_stamps

NUMBA = {
    "plain numba loops, one core": (brush_numba, False),
    "plain numba loops, all cores": (brush_numba, True),
    "blocked numba loops, one core": (brush_lanes, False),
    "blocked numba loops, all cores": (brush_lanes, True),
}
"""Peers by name: the module, and whether bristles spread over cores."""


def step_flops(nodes: int, iterations: int, contact_nodes: int) -> int:
    """Operations of one quasi-static stamp of one bristle, counted from the method.

    Per segment: rest direction 18; bending residual 24; direction and frame 18; tangent
    components 12 in, 12 for the friction force; whitening by substitution in the bidiagonal
    factor, 3 each for 5 columns, 2 components in, and 2 x 2 for the turn: 33; products of the
    columns 27; the turned, rescaled segment 20. Per tracked node 3; friction 190.
    """
    segment = 24 + 18 + 24 + 33 + 27 + 20
    return (nodes - 1) * (18 + iterations * segment) + iterations * (190 + 20 * contact_nodes)


def step_bytes(nodes: int, contact_nodes: int) -> int:
    """Bytes a stamp of one bristle must move in float32: segments in and out, rest shape, contact
    force and place in and out, the track out."""
    return 4 * (3 * 3 * (nodes - 1) + 12 * contact_nodes + 6 * contact_nodes)


def peak_flops() -> float:
    """Operations per second of the busiest loop XLA makes here: a float32 matrix product."""
    a = jnp.ones((768, 768), jnp.float32)
    product = jax.jit(lambda x: jnp.matmul(x, x, precision=jax.lax.Precision.HIGHEST))
    return 2 * 768**3 / timed(product, a, repeats=20, budget=1.0)[1].low


def stream_bytes() -> float:
    """Bytes per second of a loop over 1 MB, the size of a brush with its intermediate values."""
    a = np.ones(1 << 17, np.float32)
    b = np.empty_like(a)
    best = np.inf
    for _ in range(200):
        start = time.perf_counter()
        np.add(a, 1.0, out=b)
        best = min(best, time.perf_counter() - start)
    return 2 * a.nbytes / best


def start_seconds() -> tuple[float, float]:
    """What XLA needs to start one fused loop, and one matrix product, inside a scan: a chain of
    products of 4 x 4 matrices, with and without a loop after each."""
    chain, steps = 16, 2000
    matrix = jnp.eye(4, dtype=jnp.float32)

    def run(between):
        def body(x, _):
            for _ in range(chain):
                x = between(jnp.matmul(matrix, x, precision=jax.lax.Precision.HIGHEST))
            return x, None

        scan = jax.jit(lambda x: jax.lax.scan(body, x, None, length=steps)[0])
        low = timed(scan, jnp.ones((4, 8), jnp.float32), repeats=15)[1].low
        return low / (chain * steps)

    product = run(lambda x: x)
    return max(run(lambda x: jnp.maximum(x, 0.5)) - product, 0.0), product


def scan_operations(config: BrushConfig, params, stroke) -> tuple[int, int]:
    """Fused loops and matrix products that XLA starts per stamp, in the compiled rollout."""
    text = roll.lower(config, params, stroke).compile().as_text()
    bodies = re.split(r"\n(?=(?:ENTRY )?%\S+ \()", text)
    named = {re.match(r"(?:ENTRY )?%(\S+)", b.strip()).group(1): b for b in bodies[1:]}
    loops = [named[name] for name in re.findall(r"body=%([\w.\-]+)", text) if name in named]
    largest = max(loops, key=len)
    return (
        len(re.findall(r" (?:fusion|copy|call|custom-call|dynamic-update-slice)\(", largest)),
        len(re.findall(r" dot\(", largest)),
    )


def floor(config: BrushConfig, bristles: int, stamps: int, operations: tuple[int, int]) -> dict:
    """Least time of a stroke [s] by arithmetic, by memory, and by starting operations."""
    stamps = len(solved_stamps(stamps, config.solve_stride)) + config.approach
    flops = step_flops(config.nodes, config.iterations, config.contact_nodes) * bristles
    moved = step_bytes(config.nodes, config.tracked_nodes) * bristles
    peak, stream, (loop, product) = peak_flops(), stream_bytes(), start_seconds()
    return {
        "flops_per_solve": flops,
        "bytes_per_solve": moved,
        "peak_gflops": peak / 1e9,
        "stream_gbytes": stream / 1e9,
        "start_loop_us": loop * 1e6,
        "start_product_us": product * 1e6,
        "loops_per_solve": operations[0],
        "products_per_solve": operations[1],
        "arithmetic_s": stamps * flops / peak,
        "memory_s": stamps * moved / stream,
        "starts_s": stamps * (operations[0] * loop + operations[1] * product),
    }


def numba_peers(config: BrushConfig, params, kind: str, repeats: int):
    """Time and agreement of the numba loops on one stroke, at the stamps that the default solves.

    In numba's favour, poses are made beforehand and the stamps between are not filled in. All
    take turns, so that a busy machine is busy for each.

    Returns:
      (Timing of `config` itself, {name: (Timing, largest distance of a tip from JAX's [mm],
      largest difference of a bristle's force over the largest force)}, empty without numba).
    """
    with jax.enable_x64(True):
        stroke = stroke_of(kind, STAMP)
    stroke, params = single(stroke), single(params)
    solved = solved_stamps(stroke.time.shape[0], config.solve_stride)
    track = roll(config, params, stroke)
    tip, pressed = track.position[solved, -1], track.force[solved].sum(1)
    few = jax.tree.map(lambda x: x[solved], stroke)
    pose = poses(params, few, config.approach)
    runs, apart = {"": lambda: roll(config, params, stroke)}, {}
    for name, (module, parallel) in NUMBA.items() if brush_numba.numba else ():
        run = partial(module.make_rollout(config, parallel), *module.inputs(config, params, pose))
        position, force = (x[config.approach :] for x in module.arranged(*run()))
        far = float(np.max(np.abs(position[:, -1] - tip)))
        runs[name] = run
        apart[name] = far, float(np.max(np.abs(force.sum(1) - pressed)) / np.max(pressed))
    turns = [{k: timed(run, repeats=3)[1] for k, run in runs.items()} for _ in range(repeats)]
    times = {
        k: Timing(
            turns[0][k].first,
            min(turn[k].low for turn in turns),
            float(np.median([turn[k].median for turn in turns])),
        )
        for k in runs
    }
    return times.pop(""), {k: (times[k], *apart[k]) for k in times}
