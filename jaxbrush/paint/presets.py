"""Settings of the simulator worth a name, each (PaintConfig, PaintParams, stamp spacing [mm]).

The numbers are of `python -m experiments.paint_accuracy`: 9 mm of a 4.5 mm flat brush over a wet
band, against `reference`, on 2 cores with AVX2 (150 GFLOP/s in matrix products).
"""

from jaxbrush.paint.state import PaintConfig, PaintParams, for_brush, make_params

REAL = 260
"""Bristles of the brush that the default constants are for."""


def params_of(bristles: int = REAL) -> PaintParams:
    """The default constants, for a brush of so many bristles: fewer stand for more hairs each."""
    return for_brush(make_params(), 4.5, 1.4, bristles)


def offline(bristles: int = REAL) -> tuple[PaintConfig, PaintParams, float]:
    """What data are made with: 10 ms a stamp, 0.23 s a millimetre; 43 um rms, 1.3 Delta E, in a
    film of 309 um, and 13 % less paint laid.

    The interval of the stamps counts most: at a whole pixel 134 um and 4.1, for half the time; at
    two 200 um and 6.3. Cells twice as high take 0.6 of the time, for 33 um and 1.7. At this
    interval 3 + 5 rounds leave 101 um, 1 + 2 lay 19 % more than the reference, 190 um; 18 + 40
    come to 52 um. The other solvers at as many rounds come to 41 to 54 um.
    """
    return PaintConfig(solver="chebyshev"), params_of(bristles), 0.0625


def realtime(bristles: int = REAL // 2) -> tuple[PaintConfig, PaintParams, float]:
    """The fastest that still shows the grooves and no beads: 0.6 ms a stamp, 3.3 ms a millimetre
    with 130 bristles; 140 um rms, 3.7 Delta E.

    Pixels of 0.25 mm and as much between stamps, cells 0.2 mm high, 2 + 3 rounds, fluxes without
    limiter: at this interval it sharpens nothing. At 0.5 mm, with 65 bristles, grooves come out as
    bumps. The same pixels and interval with the rest as in `offline` cost six times as much, for
    147 um and 3.3.
    """
    config = PaintConfig(
        pixel=0.25, layer=0.2, layers=5, window=24, samples=2, sweeps=1, viscous=2, pressure=3,
        solver="chebyshev", spectrum=0.9, limiter=False,
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
