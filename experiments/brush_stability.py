"""The stability map: step and stiffness at which each integrator holds, drifts or breaks."""

import dataclasses

import jax
import numpy as np

from experiments.brush_cases import STAMP, Motion, brush_of, errors, roll, single, stroke_of
from experiments.common import INK, save_figure
from jaxbrush.brush import BrushConfig

DURATION = 0.032
"""[s] of the stroke: pressed and pulled, with a reversal."""
SHARED = 0.008
"""[s] between the instants that are compared."""
TIP_LIMIT, FORCE_LIMIT = 1.0, 5.0
"""[%] of tip and force error beyond which a stable setting is called biased."""
CLASSES = ("stable", "biased", "blown up")
SHADES = ("#dfe8d2", "#f3d9a4", "#d98a74")


def _stroke(interval: float):
    stroke = stroke_of("zigzag", interval, DURATION)
    time = np.asarray(stroke.time)
    x = 20.0 + 1.2 * np.sin(100.0 * time)
    position = np.stack([x, np.full_like(x, 20.0)], 1)
    return dataclasses.replace(
        stroke, position=position, pressure=0.1 + 0.3 * np.minimum(time / 0.02, 1.0)
    )


def _track(config, params, factors, stroke):
    """Rollouts of the brush of hair whose modulus is times each of `factors`."""

    def one(factor):
        stiff = {"bending": params.bending * factor, "stretch": params.stretch * factor}
        return roll(config, dataclasses.replace(params, **stiff), stroke)

    return jax.vmap(one)(factors)


def _motion(track, which: int, stride: int) -> Motion:
    tip = np.asarray(track.position[which, ::stride, -1], np.float64)
    return Motion(tip, np.asarray(track.force[which, ::stride], np.float64).sum(1))


def _judge(error, length_percent=100.0) -> int:
    if not error.finite or error.tip > length_percent:
        return 2
    return int(error.tip > TIP_LIMIT or error.force > FORCE_LIMIT)


def run(quick: bool, folder, progress) -> dict:
    """Draws the map of every integrator into `folder`.

    Returns:
      {integrator: {"step_s": [...], "stiffness": [...], "tip": rows, "force": rows, "class": rows}}
      with one row a stiffness.
    """
    count = 3 if quick else 9
    factors = np.logspace(-2, 2, count)
    params = brush_of("flat", 8)
    fine = 1400 if quick else 2400
    implicit = (1e-3,) if quick else (0.25e-3, 0.5e-3, 1e-3, 2e-3, 4e-3, 8e-3)
    substeps = (128,) if quick else (32, 64, 96, 128, 256, 512, 1024)
    plans = {
        "symplectic_euler": [(STAMP, s) for s in substeps[::-1]],
        "verlet": [(STAMP, s) for s in substeps[::-1]],
        "implicit_euler": [(interval, 1) for interval in implicit],
        "projective": [(interval, 1) for interval in implicit],
        "quasi_static": [(interval, 1) for interval in implicit],
    }
    task = progress.add_task("stability", total=sum(map(len, plans.values())) + 1)
    with jax.enable_x64(True):
        config = BrushConfig(integrator="verlet", substeps=fine, contact_nodes=3)
        reference = jax.device_get(_track(config, params, factors, _stroke(STAMP)))
    progress.advance(task)
    length = float(np.mean(params.length))
    result = {}
    for kind, plan in plans.items():
        iterations = 3 if kind == "implicit_euler" else 2 if kind == "projective" else 1
        found = {"tip": [], "force": [], "class": []}
        for interval, steps in plan:
            config = BrushConfig(integrator=kind, substeps=steps, iterations=iterations)
            with jax.enable_x64(True):
                stroke = _stroke(interval)
            track = _track(config, single(params), single(factors), single(stroke))
            track = jax.device_get(track)
            cells = []
            for which in range(count):
                mine = _motion(track, which, round(SHARED / interval))
                true = _motion(reference, which, round(SHARED / STAMP))
                cells.append(errors(mine, true, length))
            found["tip"].append([e.tip for e in cells])
            found["force"].append([e.force for e in cells])
            found["class"].append([_judge(e) for e in cells])
            progress.advance(task)
        found = {name: np.array(rows).T for name, rows in found.items()}
        result[kind] = {"step_s": [i / s for i, s in plan], "stiffness": factors, **found}
    _chart(result, folder / "stability.png")
    return result


def _chart(result: dict, path) -> None:
    import matplotlib.pyplot as plt
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    figure, axes = plt.subplots(1, len(result), figsize=(3.3 * len(result), 5.0), sharey=True)
    for axis, (kind, cell) in zip(axes, result.items(), strict=True):
        axis.imshow(cell["class"], cmap=ListedColormap(SHADES), vmin=0, vmax=2, aspect="auto",
                    origin="lower")  # fmt: skip
        for i, row in enumerate(cell["tip"]):
            for j, tip in enumerate(row):
                text = "" if cell["class"][i][j] == 2 else f"{tip:.2g}"
                axis.text(j, i, text, ha="center", va="center", fontsize=7, color=INK)
        unit, scale = ("ms", 1e3) if max(cell["step_s"]) > 1e-4 else ("µs", 1e6)
        steps = [f"{scale * s:.3g}" for s in cell["step_s"]]
        axis.set_xticks(range(len(steps)), steps, rotation=60)
        axis.set_yticks(range(len(cell["stiffness"])), [f"{f:.2g}" for f in cell["stiffness"]])
        axis.set(xlabel=f"step [{unit}]", title=kind.replace("_", " "))
        axis.grid(False)
    axes[0].set_ylabel("modulus of the hair, times hog (bending and stretch)")
    figure.legend(
        handles=[Patch(color=c, label=t) for c, t in zip(SHADES, CLASSES, strict=True)],
        loc="outside lower center", ncols=3,
    )  # fmt: skip
    figure.suptitle(
        "Where each integrator holds. Numbers: rms tip error [% of bristle length]; biased: tip "
        f"> {TIP_LIMIT:g} % or force > {FORCE_LIMIT:g} %; 8 bristles, a short pressed zig-zag",
        x=0.01, ha="left", fontsize=10,
    )  # fmt: skip
    save_figure(figure, path)
