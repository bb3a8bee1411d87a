"""The numba loops that the brush is measured against compute the brush's numbers."""

import jax
import numpy as np
import pytest

pytest.importorskip("numba")

from experiments import brush_lanes, brush_numba  # noqa: E402
from experiments.brush_cases import STAMP, brush_of, roll, single, stroke_of  # noqa: E402
from jaxbrush.brush import BrushConfig  # noqa: E402
from jaxbrush.brush.handle import poses  # noqa: E402


@pytest.mark.slow
@pytest.mark.parametrize("peer", (brush_numba, brush_lanes))
@pytest.mark.parametrize("contacts, iterations", ((1, 1), (3, 2)))
def test_loops_follow_the_brush(peer, contacts, iterations):
    config = BrushConfig(stride=1, contact_nodes=contacts, iterations=iterations)
    params = single(brush_of("flat", 32))
    with jax.enable_x64(True):
        stroke = stroke_of("zigzag", 2 * STAMP)
    stroke = single(stroke)
    track = roll(config, params, stroke)
    run = peer.make_rollout(config)
    found = run(*peer.inputs(config, params, poses(params, stroke, config.approach)))
    position, force = (x[config.approach :] for x in peer.arranged(*found))
    # Rounding in another order: tips 20 mm below the clamp, which stick or slip.
    np.testing.assert_allclose(position, track.position, atol=1e-3)
    top = float(track.force.max())
    np.testing.assert_allclose(force, track.force[:, -contacts:], atol=2e-3 * top)
