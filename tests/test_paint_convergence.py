"""What finer cells, more rounds and larger canvases change: orders, and costs."""

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from paint_cases import BRISTLES, CONFIG, SIDE, params_of, stroke, track

from jaxbrush.paint import (
    PaintConfig,
    empty_canvas,
    for_brush,
    height,
    load_brush,
    make_params,
)
from jaxbrush.paint.velocity import viscous


def test_dragged_paint_follows_brinkmans_profile_to_second_order(x64):
    """A wide bed of hair of even density through the whole film, moving by one cell:
    u'' = k^2 (u - 1), no slip on the canvas, no stress at the surface, is
    u = 1 - cosh(k (h - z)) / cosh(k h), k^2 = drag phi."""
    phi, deep, params = 0.1, 0.5, make_params()

    def error(layers):
        config = PaintConfig(
            layers=layers + 1, layer=deep / layers, window=8, viscous=300, spectrum=0.97
        )
        n = config.window**2
        fill = jnp.ones((layers + 1, n)).at[layers].set(0.0)
        hair = jnp.full(fill.shape, phi).at[layers].set(0.0)
        # Hair takes no room here: paint and hair together fill the cell.
        motion = jnp.zeros((layers + 1, 3, n)).at[:, 0].set(1.0)
        u, left = jax.jit(viscous, static_argnums=0)(config, params, fill, hair, motion)
        assert float(left[0]) < 1e-9
        speed = np.asarray(u)[:layers, 0, config.window : -config.window]
        assert np.ptp(speed, axis=1).max() < 1e-9
        # What keeps dry cells from being singular is drag at rest.
        drag = float(params.drag) * phi
        rest = 1e-3 / config.pixel**2
        k, z = np.sqrt(drag + rest), (np.arange(layers) + 0.5) * config.layer
        want = drag / (drag + rest) * (1.0 - np.cosh(k * (deep - z)) / np.cosh(k * deep))
        return np.abs(speed[:, 0] - want).max()

    found = [error(layers) for layers in (4, 8, 16, 32)]
    order = np.log2(np.array(found[:-1]) / found[1:])
    print("error", [f"{e:.1e}" for e in found], "order", np.round(order, 2))
    assert found[1] < 0.015
    assert np.all(np.diff(order) > 0.0) and order[-1] > 1.8


def test_paint_under_a_dragged_layer_follows_couettes_profile(x64):
    """Hair in the uppermost layer only: below it u'' = k^2 u, k^2 the drag at rest that keeps dry
    cells from being singular, so u = sinh(k z) / sinh(k z_top) of the top's: nearly a line."""
    params, layers, deep = make_params(), 16, 0.5
    config = PaintConfig(
        layers=layers + 1, layer=deep / layers, window=8, viscous=600, spectrum=0.97
    )
    n = config.window**2
    fill = jnp.ones((layers + 1, n)).at[layers].set(0.0)
    hair = jnp.zeros(fill.shape).at[layers - 1].set(0.5)
    motion = jnp.zeros((layers + 1, 3, n)).at[:, 0].set(1.0)
    u, left = jax.jit(viscous, static_argnums=0)(config, params, fill, hair, motion)
    assert float(left[0]) < 1e-9
    speed = np.asarray(u)[:layers, 0, config.window : -config.window].mean(1)
    k, z = np.sqrt(1e-3) / config.pixel, (np.arange(layers) + 0.5) * config.layer
    want = speed[-1] * np.sinh(k * z) / np.sinh(k * z[-1])
    print("off by", np.abs(speed - want).max(), "top", speed[-1])
    assert 0.5 < speed[-1] < 1.0
    np.testing.assert_allclose(speed, want, atol=1e-4)
    # Without drag, or with no hold on the canvas, it would move as a block or not at all.
    assert speed[0] < 0.05 * speed[-1] and np.all(np.diff(speed) > 0.0)


def films(*changes, step=0.06):
    """Film [mm] of the shared stroke, stamps `step` apart [mm], for settings `changes`."""
    moves = track(step=step, stamps=round(64 * 0.06 / step))
    for change in changes:
        config = dataclasses.replace(CONFIG, **change)
        side = round(SIDE * CONFIG.pixel / config.pixel)
        brush = load_brush(config, params_of(), BRISTLES, 0.8, jnp.asarray([1.0, 0.0]))
        canvas, _, report = stroke(
            config, params_of(), empty_canvas(config, (side, side)), brush, moves
        )
        assert bool(report.reached.all())
        yield np.asarray(height(config, canvas), np.float64)


def blocks(film, size):
    """Means over squares, as many along a side as `size`."""
    n = film.shape[0] // size
    return film.reshape(size, n, size, n).mean((1, 3))


def errors(name, found, size):
    """rms to the finest [um]; prints it, the order of what changes, and what is laid [mm^3]."""
    found = [blocks(f, size) for f in found]
    wet = found[-1] > 0.01
    rms = lambda a, b: 1e3 * np.sqrt(np.mean((a - b)[wet] ** 2))  # noqa: E731
    steps = np.array([rms(a, b) for a, b in zip(found, found[1:], strict=False)])
    error = np.array([rms(f, found[-1]) for f in found[:-1]])
    laid = [f.sum() * (SIDE * CONFIG.pixel / size) ** 2 for f in found]
    print(f"{name}: rms to the finest [um] {np.round(error, 1)}, to the next finer "
          f"{np.round(steps, 1)}, order {np.round(np.log2(steps[:-1] / steps[1:]), 2)}, "
          f"laid {np.round(laid, 3)}")  # fmt: skip
    return error


def thicker(params, times):
    """The naive way to let a bristle stand for `times` hairs: one hair of their cross-section,
    under a coat as thick as before."""
    root = np.sqrt(times)
    return dataclasses.replace(
        params,
        hair_radius=params.hair_radius * root,
        coat_dry=params.coat_dry / root,
        coat_full=params.coat_full / root,
    )


def test_fewer_bristles_lay_as_much():
    few, all_of_them = (for_brush(make_params(), 4.5, 1.4, n) for n in (65, 260))
    assert float(few.hairs) == pytest.approx(4.0) and float(all_of_them.hairs) == pytest.approx(1.0)
    assert few.hair_radius == all_of_them.hair_radius and few.coat_full == all_of_them.coat_full
    moves = track()

    def laid(params, every, first):
        some = dataclasses.replace(
            moves, **{n: getattr(moves, n)[..., first::every] for n in ("position", "force")}
        )
        brush = load_brush(CONFIG, params, BRISTLES // every, 0.8, jnp.asarray([1.0, 0.0]))
        canvas, *_ = stroke(CONFIG, params, empty_canvas(CONFIG, (SIDE, SIDE)), brush, some)
        return float(jnp.sum(height(CONFIG, canvas)))

    full = laid(params_of(), 1, 0)
    # Every quarter of the bristles, for one alone rides higher or lower than the brush.
    quarters = lambda params: np.mean([laid(params, 4, k) for k in range(4)]) / full - 1.0  # noqa: E731
    more, thick = quarters(params_of(hairs=4)), quarters(thicker(params_of(), 4))
    print("laid with a quarter of the bristles:", more, "as thicker hairs:", thick)
    # Ten bristles, a third of a millimetre apart, leave rows of columns that none passes over.
    assert abs(more) < 0.13 and thick < 1.5 * more


@pytest.mark.slow
def test_a_stroke_converges_as_stamps_get_closer():
    found = [next(films({}, step=0.24 / 2**n)) for n in range(6)]
    error = errors("stamps", found, SIDE)
    assert error[1] < error[0] and np.all(error[2:] < 0.6 * error[1:-1])


CONVERGED = {"viscous": 60, "spectrum": 0.99, "solver": "zline_pcg", "pressure": 40}


@pytest.mark.slow
def test_a_stroke_converges_as_layers_get_thinner():
    # Points along a hair have to lie as close as layers do, or thin layers see beads in place of
    # hair; and stamps, since paint rises by at most a layer in one.
    def films_of(samples, step):
        layers = ({"layer": 0.5 / n, "layers": n, "samples": samples} for n in (4, 8, 16, 32))
        return list(films(*(x | CONVERGED for x in layers), step=step))

    fine = errors("layers", films_of(16, 0.0075), SIDE)
    assert np.all(fine[1:] < 0.7 * fine[:-1]) and fine[1] < 12.0
    beads, jumps = (
        errors("beads", films_of(2, 0.0075), SIDE),
        errors("jumps", films_of(16, 0.06), SIDE),
    )
    # Either alone spoils it.
    assert min(beads[1], jumps[1]) > 1.5 * fine[1]


@pytest.mark.slow
def test_a_stroke_converges_as_pixels_get_smaller():
    # A bristle with its coat is as wide as a pixel of 0.125 mm; finer pixels have to spread it, or
    # they resolve hairs one by one. Stamps are a quarter of the finest pixel apart, and rounds as
    # many as solve the finest.
    def films_of(across):
        grids = ((24, 1), (48, 2), (96, 4)) if across else ((24, 1), (48, 1), (96, 1))
        return list(films(*({"pixel": 3.0 / n, "window": n, "across": a} | CONVERGED
                            for n, a in grids), step=0.0075))  # fmt: skip

    spread, thin = (errors(name, films_of(a), SIDE) for name, a in (("spread", 1), ("thin", 0)))
    assert spread[1] < 0.6 * spread[0] and spread[0] < 40.0
    # The naive way is off by more, and by no less on the finer grid of the two.
    assert thin[1] > 2.0 * spread[1]


@pytest.mark.slow
def test_a_stamp_costs_no_more_on_a_large_canvas():
    moves, params = track(), params_of()
    brush = load_brush(CONFIG, params, BRISTLES, 0.8, jnp.asarray([1.0, 0.0]))
    calls = []
    for side in (128, 512):
        canvas = empty_canvas(CONFIG, (side, side))
        calls.append(
            lambda c=canvas: jax.block_until_ready(stroke(CONFIG, params, c, brush, moves))
        )
        calls[-1]()
    best = [np.inf, np.inf]
    for _ in range(6):
        for k, call in enumerate(calls):
            start = time.process_time()
            call()
            best[k] = min(best[k], time.process_time() - start)
    stamps = int(moves.valid.sum())
    print("ms a stamp on 128^2 and 512^2:", np.round(1e3 * np.array(best) / stamps, 2))
    # A copy of 512^2 cells a stamp would take 5 ms more; one a stroke is allowed.
    assert best[1] < 1.25 * best[0]
