"""What the paint simulator is made of: grid, constants, and the paint on canvas and brush."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.canvas import OPACITY
from jaxbrush.structs import config, state

SOLVERS = ("zline_pcg", "jacobi_pcg", "chebyshev", "fixed_point")


@config
class PaintConfig:
    """Static choices of the simulator.

    pixel, layer: cell size along and across the canvas [mm]. layers: cells above the canvas.
    window: cells along a side of the region that is simulated, around the brush. pigments: how
    many are mixed. samples: points on each bristle's lowest part. sweeps: points of each along
    its way from stamp to stamp. across: pixels that a bristle with its coat is wide, 1 for
    pixels of 0.125 mm, n for pixels n times finer. viscous, pressure: iterations. solver: of
    the pressure, one of `SOLVERS`; the default needs no guess of the spectrum, `offline` and
    `realtime` take Chebyshev's iteration, which is cheaper where few rounds do. spectrum: radius
    that it is made for, below 1. limiter: second-order lateral fluxes.
    """

    pixel: float = 0.125
    layer: float = 0.0625
    layers: int = 16
    window: int = 64
    pigments: int = 4
    samples: int = 8
    sweeps: int = 1
    across: int = 1
    viscous: int = 9
    pressure: int = 20
    solver: str = "zline_pcg"
    spectrum: float = 0.95
    limiter: bool = True

    def __post_init__(self):
        for name, least in (
            ("layers", 2), ("window", 8), ("pigments", 1), ("samples", 1), ("sweeps", 1),
            ("across", 1), ("viscous", 1), ("pressure", 1),
        ):  # fmt: skip
            value = getattr(self, name)
            if not isinstance(value, int) or value < least:
                raise ValueError(f"PaintConfig.{name} = {value!r}: expected an integer >= {least}")
        for name in ("pixel", "layer"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"PaintConfig.{name} = {getattr(self, name)!r}: expected > 0 mm")
        if not 0.0 <= self.spectrum < 1.0:
            raise ValueError(f"PaintConfig.spectrum = {self.spectrum!r}: expected in [0, 1)")
        if self.solver not in SOLVERS:
            raise ValueError(f"PaintConfig.solver = {self.solver!r}: expected one of {SOLVERS}")

    @property
    def ratio(self) -> float:
        """(pixel / layer)^2, how much stronger the vertical coupling is."""
        return (self.pixel / self.layer) ** 2

    @property
    def cell(self) -> float:
        """Volume of a cell [mm^3]."""
        return self.pixel * self.pixel * self.layer


@state
class PaintParams:
    """Constants of paint and hair, all scalars; lengths in mm, rates per mm of travel.

    Tuned by eye by a prototype at 0.125 mm; stated in physical units so that pixel size, bristle
    count and stamp interval may change.
    """

    hair_radius: jax.Array  # of a real hair in the paint [mm]
    hairs: jax.Array  # real hairs that a simulated bristle stands for
    hair_length: jax.Array  # lowest part of a bristle that meets paint [mm]
    coat_dry: jax.Array  # coat of paint on a dry hair, times hair_radius
    coat_full: jax.Array  # what a full tip adds to that, times hair_radius
    compliance: jax.Array  # share of the way to the paint's surface a bristle rides up
    tip_volume: jax.Array  # capacity of all tips together [mm^3]
    reservoir_volume: jax.Array  # capacity of the brush behind them [mm^3]
    contact_area: jax.Array  # over which all bristles together touch [mm^2]
    deposit: jax.Array  # [1/mm]
    cling: jax.Array  # a hair that rises as 1 in this gives nothing
    squeeze: jax.Array  # [1/mm]
    pickup: jax.Array  # [1/mm]
    exchange: jax.Array  # [1/mm]
    exchange_depth: jax.Array  # of the paint that bristles exchange with [mm]
    refill: jax.Array  # [1/mm]
    soak: jax.Array  # travel that contact at rest counts as [mm/s]
    drag: jax.Array  # Brinkman drag of the hair over viscosity, per hair fraction [1/mm^2]
    lid: jax.Array  # share of upward flow that the bed of hair stops
    source: jax.Array  # share of an overfull cell's excess that flows out in a stamp
    bound: jax.Array  # film next to the cloth that does not flow [mm]
    yield_share: jax.Array  # flow below this share of the brush's travel stops
    relax: jax.Array  # [mm^2/mm] at which steep slopes of the surface diffuse near hair
    relax_slope: jax.Array  # slope that stands
    opacity: jax.Array  # film thickness that hides 63 % of what is under it [mm]


def make_params(**changes) -> PaintParams:
    """The default constants; `changes` by name.

    Raises:
      ValueError: a name that is not a constant.
    """
    values = {
        "hair_radius": 0.03, "hairs": 1.0, "hair_length": 0.9, "coat_dry": 0.33, "coat_full": 8.0,
        "compliance": 0.4, "tip_volume": 7.5, "reservoir_volume": 63.0, "contact_area": 20.0,
        "deposit": 12.8, "squeeze": 0.4, "cling": 4.0, "pickup": 4.0, "exchange": 0.48,
        "exchange_depth": 0.125, "refill": 0.8, "soak": 10.0, "drag": 256.0, "lid": 0.9,
        "source": 1.0, "bound": 0.012, "yield_share": 0.02, "relax": 0.015625, "relax_slope": 0.752,
        "opacity": OPACITY,
    }  # fmt: skip
    unknown = set(changes) - set(values)
    if unknown:
        raise ValueError(f"{sorted(unknown)}: expected names among {sorted(values)}")
    return PaintParams(**{k: jnp.asarray(v, float) for k, v in (values | changes).items()})


TUNED_AREA, TUNED_HAIRS = 4.5 * 1.4, 260
"""Ferrule [mm^2] and hair count of the brush that the default constants belong to."""


def for_brush(
    params: PaintParams, width, thickness, bristles: int, disc: bool = False
) -> PaintParams:
    """The constants for a brush of another size or bristle count: it holds paint by the area of its
    ferrule, and fewer bristles stand for more hairs each. They have the volume of all these hairs,
    but the film they are in equilibrium with is that of a single one.

    Args:
      width, thickness: of the ferrule [mm]. bristles: simulated. disc: round ferrule.
    """
    share = width * thickness / TUNED_AREA * (0.25 * np.pi if disc else 1.0)
    return dataclasses.replace(
        params,
        tip_volume=params.tip_volume * share,
        reservoir_volume=params.reservoir_volume * share,
        contact_area=params.contact_area * share,
        hairs=params.hairs * share * TUNED_HAIRS / bristles,
    )


COARSE = 0.125
"""Pixel [mm] above which slopes of the surface are not resolved: coarser pixels relax like it, or
`presets.realtime` would be 8 % farther from the truth."""


def relaxation(config: PaintConfig, params: PaintParams, step):
    """(share of a steep step that goes to each lower neighbour in a stamp; step that stands [mm]),
    for a brush that travels `step` [mm]."""
    size = min(config.pixel, COARSE)
    share = 0.25 * (1.0 - jnp.exp(-4.0 * params.relax * step / size**2))
    return share, params.relax_slope * size


@state
class BrushPaint:
    """Paint in the brush, by pigment k and bristle b. tip, reservoir: (k, b) [mm^3]."""

    tip: jax.Array
    reservoir: jax.Array


def empty_canvas(config: PaintConfig, shape) -> jax.Array:
    """Bare canvas (z, k, y, x): share of each cell that each pigment fills, of `shape` (h, w).

    Raises:
      ValueError: a canvas smaller than the window.
    """
    h, w = shape
    if min(h, w) < config.window:
        raise ValueError(f"shape = {(h, w)}: expected at least the window, {config.window} cells")
    return jnp.zeros((config.layers, config.pigments, h, w), float)


def load_brush(config: PaintConfig, params: PaintParams, bristles: int, load, mix) -> BrushPaint:
    """A brush dipped in paint.

    Args:
      bristles: count b.
      load: share of the capacity, () or (b,).
      mix: shares of the pigments, (k,) or (k, b).
    """
    mix = jnp.asarray(mix, float)
    mix = jnp.broadcast_to(mix.reshape(config.pigments, -1), (config.pigments, bristles))
    share = jnp.broadcast_to(jnp.asarray(load, float), (bristles,))[None] / bristles
    return BrushPaint(
        tip=params.tip_volume * share * mix, reservoir=params.reservoir_volume * share * mix
    )


def volume(config: PaintConfig, canvas) -> jax.Array:
    """(k,) volume of each pigment on a canvas [mm^3]."""
    return config.cell * jnp.sum(canvas, axis=(0, 2, 3))


def height(config: PaintConfig, canvas) -> jax.Array:
    """(y, x) thickness of the paint [mm]."""
    return config.layer * jnp.sum(canvas, axis=(0, 1))


RELIEF = 0.03
"""Depth of the usual weave [mm]: any brush fills it. On one of some 0.09 mm a dry brush catches."""


def weave(shape, pixel: float, depth=RELIEF, pitch: float = 0.45, first=(0, 0)) -> jax.Array:
    """Height of a plain-woven canvas, (y, x) [mm]: threads `pitch` apart, going over and under.

    Args:
      depth: () [mm]. first: number of the first pixel (y, x) on the canvas, may be traced.
    """
    y, x = (
        (jnp.arange(n, dtype=jnp.int32) + at).astype(float) * (pixel / pitch)
        + 0.5 * (pixel / pitch)
        for n, at in zip(shape, first, strict=True)
    )
    y, x = y[:, None], x[None, :]
    odd = jnp.mod(jnp.floor(y) + jnp.floor(x), 2.0)
    across, along = jnp.abs(jnp.sin(jnp.pi * y)), jnp.abs(jnp.sin(jnp.pi * x))
    return depth * jnp.where(odd > 0.5, along, across)
