"""The real brush in paint: how hard it is pressed, and strokes of real hands."""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from paint_cases import (
    BRISTLES,
    CONFIG,
    MIDDLE,
    STAMPS,
    bare,
    brush_of,
    check_sound,
    film,
    paint,
    slab,
)

from jaxbrush import recordings
from jaxbrush.brush import BrushConfig, make_brush, rollout
from jaxbrush.stylus import make_stroke, resample

DATA = Path(__file__).parents[2] / "shared" / "data"
FILES = {
    "mypaint": (recordings.read_mypaint, "painting_recording.dat"),
    "wacom": (recordings.read_wacom, "pen_strokes_tilt.jsonl.gz"),
}
SAMPLES = 256
"""Samples that strokes are brought to, so that all share one compilation."""
jit_rollout, jit_resample = jax.jit(rollout), jax.jit(resample, static_argnums=1)


@functools.cache
def hair():
    make = jax.jit(
        lambda k: make_brush(k, BrushConfig(), "flat", BRISTLES, width=1.5, thickness=1.0)
    )
    return make(jax.random.key(0))


def track_of(t, place, pressure, altitude, azimuth):
    """Bristle track of a stroke (numpy, any number of samples), STAMPS stamps a pixel apart or, of
    a longer stroke, farther."""
    if len(t) > SAMPLES:
        # Every so many, the last among them.
        some = np.linspace(0, len(t) - 1, SAMPLES).round().astype(int)
    else:
        some = np.minimum(np.arange(SAMPLES), len(t) - 1)
    t, place, pressure, altitude, azimuth = (
        np.asarray(a, np.float32)[some] for a in (t, place, pressure, altitude, azimuth)
    )
    stroke = make_stroke(place, t, pressure, altitude, azimuth)
    track = jit_rollout(BrushConfig(), hair(), jit_resample(stroke, STAMPS, 0.12, np.inf, 5.0))
    # The two nodes that paint reads, as the other tests' tracks have.
    lowest = {k: np.asarray(getattr(track, k))[:, -2:] for k in ("position", "force")}
    return dataclasses.replace(track, **{k: jnp.asarray(v) for k, v in lowest.items()})


def test_a_brush_pressed_harder_leaves_a_wider_stroke_of_more_paint():
    u = np.linspace(0.0, 1.0, 40)
    place = np.stack([1.75 + 3.5 * u, np.full_like(u, MIDDLE)], 1)
    level = np.ones_like(u)
    amounts, widths = [], []
    for pressure in (0.05, 0.1, 0.15, 0.2, 0.3):
        moves = track_of(u / 20.0, place, pressure * level, 0.9 * level, 0.0 * level)
        canvas, brush = bare(), brush_of(0.8)
        after, left, report = paint(canvas, brush, moves=moves)
        check_sound((canvas, brush), (after, left))
        # Pressed harder still, the hair spreads beyond this little window.
        assert bool(report.reached.all())
        amounts.append(film(after).sum() * CONFIG.pixel**2)
        widths.append((film(after).max(1) > 0.02).sum() * CONFIG.pixel)
    print("pressed harder: laid [mm^3]", np.round(amounts, 3), "width [mm]", np.round(widths, 2))
    assert np.all(np.diff(amounts) > 0.0)
    assert np.all(np.diff(widths) > 0.0)


def hands(name):
    """Recorded strokes of a file: dicts of numpy arrays."""
    read, file = FILES[name]
    session = read(DATA / file)
    for event in session.events:
        if isinstance(event, recordings.StrokeEvent) and len(event.t) > 3:
            stroke = recordings.to_stroke(session, event)
            yield {
                "t": np.asarray(stroke.time),
                "place": np.asarray(stroke.position),
                "pressure": np.asarray(stroke.pressure),
                "altitude": np.asarray(stroke.altitude),
                "azimuth": np.asarray(stroke.azimuth),
            }


def speed(hand):
    move = np.hypot(*np.diff(hand["place"], axis=0).T)
    return (move / np.maximum(np.diff(hand["t"]), 1e-3)).max()


def start_of(hand, way=7.0):
    """Its first `way` [mm], about the middle of the canvas."""
    move = np.hypot(*np.diff(hand["place"], axis=0).T)
    count = max(2, int(np.searchsorted(np.cumsum(move), way)) + 1)
    first = {k: v[:count] for k, v in hand.items()}
    centre = 0.5 * (first["place"].min(0) + first["place"].max(0))
    return first | {"place": first["place"] - centre + MIDDLE}


CHOICES = {
    "fastest": lambda s: -speed(s),
    "lightest": lambda s: float(s["pressure"].max()),
    "heaviest": lambda s: -float(s["pressure"].max()),
    "most tilted": lambda s: float(s["altitude"].min()),
    "longest": lambda s: -s["t"].shape[0],
}


@pytest.mark.skipif(not DATA.is_dir(), reason="no recorded strokes beside the project")
@pytest.mark.parametrize("name", FILES)
def test_recorded_strokes_paint_finite_and_conserve(name):
    all_of_them = list(hands(name))
    laid = []
    for what, order in CHOICES.items():
        hand = min(all_of_them, key=order)
        # The start as it was drawn, and the whole with stamps as far apart as they get.
        for stroke, ground in ((start_of(hand), bare()), (start_of(hand, np.inf), slab(0.2))):
            brush = brush_of(0.8)
            after, left, report = paint(ground, brush, moves=track_of(**stroke))
            check_sound((ground, brush), (after, left))
            assert np.all(np.isfinite(np.asarray(report.residual)))
            assert float(report.fullest.max()) < 1.0 + 1e-4
            laid.append((film(after) - film(ground)).sum() * CONFIG.pixel**2)
        print(f"{name} {what}: up to {speed(hand):.0f} mm/s, laid {laid[-2]:.3f}, {laid[-1]:.3f}")
    assert max(laid[::2]) > 0.1
