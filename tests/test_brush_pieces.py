"""A stroke that is drawn piece by piece moves the bristles as the whole stroke does."""

import dataclasses

import jax
import numpy as np
import pytest

from jaxbrush.brush import BrushConfig, advance, begin, make_brush, rollout
from jaxbrush.stylus import random_stroke, resample

CONFIG = BrushConfig()
PIECE = 16
move, lower, go = (jax.jit(f, static_argnums=0) for f in (rollout, begin, advance))


@pytest.fixture(scope="module")
def drawn():
    brush = make_brush(jax.random.key(0), CONFIG, "flat", 24, width=3.0, thickness=0.9,
                       length=15.0, press_depth=3.75)  # fmt: skip
    draw = jax.jit(
        lambda key: resample(random_stroke(key, 64, 8.0), 3 * PIECE + 1, 0.2, np.inf, 3.75)
    )
    return brush, draw(jax.random.key(3))


def piece_of(stroke, first, count=PIECE + 1):
    return jax.tree.map(lambda x: x[first : first + count], stroke)


def test_pieces_make_the_track_of_the_whole(drawn):
    brush, stroke = drawn
    whole = move(CONFIG, brush, stroke)
    motion = lower(CONFIG, brush, stroke)
    for first in range(0, 3 * PIECE, PIECE):
        track, motion = go(CONFIG, brush, motion, piece_of(stroke, first))
        part = slice(first, first + PIECE + 1)
        np.testing.assert_allclose(track.position, whole.position[part], atol=2e-5)
        np.testing.assert_allclose(track.force, whole.force[part], atol=5e-3)
    # Starting anew at each piece forgets how the hair was bent.
    naive = move(CONFIG, brush, piece_of(stroke, PIECE))
    gap = np.abs(naive.position - whole.position[PIECE : 2 * PIECE + 1])
    assert gap[np.asarray(naive.valid)].max() > 0.1


def test_padding_at_the_end_of_a_piece_changes_nothing_before_it(drawn):
    brush, stroke = drawn
    motion = lower(CONFIG, brush, stroke)
    piece = piece_of(stroke, 0)
    few = 8
    held = jax.tree.map(lambda x: x.at[few:].set(x[few - 1]), piece)
    held = dataclasses.replace(held, valid=np.arange(PIECE + 1) < few)
    a, _ = go(CONFIG, brush, motion, piece)
    b, _ = go(CONFIG, brush, motion, held)
    np.testing.assert_array_equal(a.position[: few - 1], b.position[: few - 1])
    assert not np.asarray(b.valid)[few:].any()


def test_only_the_brush_without_memory_comes_in_pieces(drawn):
    brush, stroke = drawn
    for other in (BrushConfig(integrator="projective"), BrushConfig(guides=8)):
        with pytest.raises(ValueError, match="in pieces"):
            begin(other, brush, stroke)
