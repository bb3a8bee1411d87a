"""Settings of the simulator worth a name, each (PaintConfig, PaintParams, stamp spacing [mm]).

The numbers are of `python -m experiments.paint_accuracy`: 9 mm of a 4.5 mm flat brush over a wet
band, against `reference`; times are of 2 cores, a slow machine's and a fast one's.
"""

from jaxbrush.paint.state import PaintConfig, PaintParams, for_brush, make_params

REAL = 260
"""Bristles of the brush that the default constants are for."""


def params_of(bristles: int = REAL) -> PaintParams:
    """The default constants, for a brush of so many bristles: fewer are thicker, so that they fill
    the same share of the paint, under a coat of the same thickness."""
    return for_brush(make_params(), 4.5, 1.4, bristles)


def offline(bristles: int = REAL) -> tuple[PaintConfig, PaintParams, float]:
    """What data are made with: 19 or 4.6 ms a stamp, 0.4 or 0.1 s a millimetre; 64 um rms, 1.7
    Delta E, in a film of 300 um, and 13 % less paint laid.

    The interval of the stamps counts most: at a whole pixel 112 um and 3.6, for half the time; at
    two 180 um and 5.9. To stamps without end the error falls by the power 1.2 of their interval.
    Cells twice as high, 75 um and 2.6, halve the time. Twice the rounds, 38 um and 5 % less paint,
    at 1.6 times the cost; half of them, 84 um; 1 + 2 lay 29 % more than the reference, 198 um. On a
    wet canvas the pressure keeps half of its error (residual 18 %), with 8 rounds of line PCG 17
    %, at twice the cost, for 56 um in place of 64.
    """
    return PaintConfig(), params_of(bristles), 0.0625


def realtime(bristles: int = REAL // 2) -> tuple[PaintConfig, PaintParams, float]:
    """The fastest that still shows the grooves and no beads: 0.7 or 0.3 ms a stamp, 4.1 or 1.6 ms
    a millimetre with 130 bristles; 117 um rms, 4.0 Delta E.

    Pixels of 0.25 mm and as much between stamps, cells 0.2 mm high, 2 + 3 rounds, fluxes without
    limiter: at this interval it sharpens nothing. Stamps 0.375 mm apart save a quarter: 170 um, 4.7
    Delta E; at 0.5 mm, with 65 bristles, grooves come out as bumps: 185 um, 7.1. With 90 bristles
    5.0 Delta E for the same time.
    """
    config = PaintConfig(
        pixel=0.25, layer=0.2, layers=5, window=24, samples=2, sweeps=1, viscous=2, pressure=3,
        spectrum=0.9, limiter=False,
    )  # fmt: skip
    return config, params_of(bristles), 0.25


def reference(bristles: int = REAL) -> tuple[PaintConfig, PaintParams, float]:
    """Finer than any use, to measure convergence by: cells half as high, a quarter of a pixel
    between stamps, solvers that leave 0.4 % (viscous) and 1e-5 (pressure)."""
    config = PaintConfig(
        layer=0.03125, layers=32, samples=16, viscous=24, solver="zline_pcg", pressure=40,
        spectrum=0.97,
    )  # fmt: skip
    return config, params_of(bristles), 0.015625
