"""Settings of the simulator worth a name, each (PaintConfig, PaintParams, stamp spacing [mm]).

The numbers are of `python -m experiments.paint_accuracy`: 9 mm of a 4.5 mm flat brush over a wet
band, against `reference`; times are CPU time on one core.
"""

from jaxbrush.paint.state import PaintConfig, PaintParams, for_brush, make_params

REAL = 260
"""Bristles of the brush that the default constants are for."""


def params_of(bristles: int = REAL) -> PaintParams:
    """The default constants, for a brush of so many bristles: fewer are thicker, so that they fill
    the same share of the paint, under a coat of the same thickness."""
    return for_brush(make_params(), 4.5, 1.4, bristles)


def offline(bristles: int = REAL) -> tuple[PaintConfig, PaintParams, float]:
    """What data are made with: 19 ms a stamp, 0.41 s a millimetre; 62 um rms, 1.7 Delta E, in a
    film of 300 um.

    The interval of the stamps counts most: at a whole pixel 111 um and 3.6, for half the time; at
    two 179 um and 6.0. Cells twice as high, 73 um and 2.6, also halve it. The rounds are enough:
    twice as many move the film by 24 um rms and lay 3 % more paint; half as many lay 12 % more,
    1 + 2 lay 61 % more. On a wet canvas the pressure keeps 39 % of its error (residual 10 %), with
    8 rounds of line PCG 21 %, at three times the cost: 12 um rms and 0.2 Delta E apart.
    """
    return PaintConfig(), params_of(bristles), 0.0625


def realtime(bristles: int = REAL // 2) -> tuple[PaintConfig, PaintParams, float]:
    """The fastest that still shows the grooves and no beads: TIMES

    Pixels of 0.25 mm and as much between stamps, cells 0.2 mm high, 2 + 3 rounds, fluxes without
    limiter: at this interval it sharpens nothing. Stamps twice as far apart save a third and cost
    the grooves, which come out as bumps (185 um, 7.1 Delta E); with 90 bristles 5.0 Delta E for
    the same time.
    """
    config = PaintConfig(
        pixel=0.25, layer=0.2, layers=5, window=24, samples=2, sweeps=1, viscous=2, pressure=3,
        limiter=False,
    )  # fmt: skip
    return config, params_of(bristles), 0.25


def reference(bristles: int = REAL) -> tuple[PaintConfig, PaintParams, float]:
    """Finer than any use, to measure convergence by: cells half as high, a quarter of a pixel
    between stamps, solvers that leave 0.4 % (viscous) and 1e-5 (pressure)."""
    config = PaintConfig(
        layer=0.03125, layers=32, viscous=24, solver="zline_pcg", pressure=40, spectrum=0.97
    )
    return config, params_of(bristles), 0.03125
