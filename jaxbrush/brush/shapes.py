"""Brush shapes in physical units: where the bristles stand, how long and how stiff they are."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbrush.structs import config, state

INTEGRATORS = ("symplectic_euler", "verlet", "implicit_euler", "projective", "quasi_static")
SHAPES = ("round", "flat", "filbert", "fan", "rigger")
DISCS = ("round", "rigger")
"""Shapes whose ferrule is an ellipse; others have a rectangle."""

HOG_DIAMETER = 0.15
"""Hog bristle [mm]."""
HOG_MODULUS = 4e9
"""Young's modulus of keratin hair [Pa]."""
HOG_DENSITY = 1.3e-3
"""[g/mm^3]"""
AXIAL_SOFTENING = 100.0
"""Bristles are made this much softer along their length than hair, still far stiffer than in
bending: a strain below 0.1 % at the buckling load, and explicit steps 10 times longer."""


@config
class BrushConfig:
    """Static choices of a rollout.

    nodes: nodes of a bristle, the clamped one included. contact_nodes: how many, from the tip
    up, can touch; pressed to the full depth at up to 60 degrees of tilt only the tip does.
    track_nodes: how many, from the tip up, are put out (the contact nodes at least).
    integrator: one of `INTEGRATORS`. iterations: Newton or projection steps a stamp. substeps:
    explicit steps a stamp. stride: stamps from one solve to the next, those between are
    interpolated along the handle's path; None is 2 when quasi-static, else 1. approach: lowering
    steps before the first stamp. press: "depth" (pressure sets how far the ferrule is lowered) or
    "force" (pressure sets the total normal force). guides: bristles that are simulated, the rest
    follow them; 0 is all.
    """

    nodes: int = 12
    contact_nodes: int = 1
    track_nodes: int = 3
    integrator: str = "quasi_static"
    iterations: int = 1
    substeps: int = 1
    stride: int | None = None
    approach: int = 8
    press: str = "depth"
    guides: int = 0

    def __post_init__(self):
        for name, least in (
            ("nodes", 3),
            ("contact_nodes", 1),
            ("track_nodes", 1),
            ("iterations", 1),
            ("substeps", 1),
            ("stride", 1),
            ("approach", 0),
            ("guides", 0),
        ):
            value = getattr(self, name)
            if name == "stride" and value is None:
                continue
            if not isinstance(value, int) or value < least:
                raise ValueError(f"BrushConfig.{name} = {value!r}: expected an integer >= {least}")
        for name in ("contact_nodes", "track_nodes"):
            if getattr(self, name) > self.nodes - 1:
                raise ValueError(
                    f"BrushConfig.{name} = {getattr(self, name)}: "
                    f"expected at most nodes - 1 = {self.nodes - 1}"
                )
        if self.integrator not in INTEGRATORS:
            raise ValueError(
                f"BrushConfig.integrator = {self.integrator!r}: expected one of {INTEGRATORS}"
            )
        if self.press not in ("depth", "force"):
            raise ValueError(f"BrushConfig.press = {self.press!r}: expected 'depth' or 'force'")
        if self.press == "force" and self.integrator not in ("projective", "quasi_static"):
            raise ValueError(
                "BrushConfig.press = 'force' needs integrator 'projective' or 'quasi_static', "
                f"not {self.integrator!r}"
            )

    @property
    def segments(self) -> int:
        return self.nodes - 1

    @property
    def solve_stride(self) -> int:
        return self.stride or (2 if self.integrator == "quasi_static" else 1)

    @property
    def tracked_nodes(self) -> int:
        return max(self.track_nodes, self.contact_nodes)


@state
class BrushParams:
    """A brush of b bristles with n segments each, in the brush frame (+z up the handle).

    root: (3, b) clamp points [mm]. rest: (n, 3, b) unit directions of the segments at rest, root
    to tip. length: (b,) [mm]. bending: (b,) EI [g mm^3/s^2]. stretch: (b,) EA [g mm/s^2].
    mass: (b,) per length [g/mm]. damping: () rate at which motion relative to the handle dies
    [1/s]. friction: () Coulomb coefficient on the canvas. press_depth: () [mm] at pressure 1.
    press_force: () total normal force at pressure 1 [µN]. area: () of the ferrule, which all
    bristles share [mm^2].
    """

    root: jax.Array
    rest: jax.Array
    length: jax.Array
    bending: jax.Array
    stretch: jax.Array
    mass: jax.Array
    damping: jax.Array
    friction: jax.Array
    press_depth: jax.Array
    press_force: jax.Array
    area: jax.Array

    def segment_length(self, segments: int):
        """Rest length l0 of a segment, (b,) [mm]."""
        return self.length / segments

    def bending_stiffness(self, segments: int):
        """EI / l0^3, (b,) [g/s^2]."""
        return self.bending / self.segment_length(segments) ** 3

    def stretch_stiffness(self, segments: int):
        """EA / l0, (b,) [g/s^2]."""
        return self.stretch / self.segment_length(segments)


# width, thickness, length, diameter [mm]; splay and point [rad at the rim]; rim_cut: how much
# shorter the rim is than the middle, as a share of the length.
_DEFAULTS = {
    "round": {"width": 6.0, "thickness": 6.0, "length": 20.0, "diameter": HOG_DIAMETER,
              "splay": 0.06, "point": 0.16, "rim_cut": 0.12},
    "flat": {"width": 10.0, "thickness": 2.5, "length": 20.0, "diameter": HOG_DIAMETER,
             "splay": 0.05, "point": 0.06, "rim_cut": 0.0},
    "filbert": {"width": 10.0, "thickness": 2.5, "length": 20.0, "diameter": HOG_DIAMETER,
                "splay": 0.05, "point": 0.08, "rim_cut": 0.22},
    "fan": {"width": 8.0, "thickness": 1.0, "length": 22.0, "diameter": HOG_DIAMETER,
            "splay": 0.55, "point": -0.45, "rim_cut": 0.08},
    "rigger": {"width": 2.0, "thickness": 2.0, "length": 30.0, "diameter": 0.1,
               "splay": 0.02, "point": 0.05, "rim_cut": 0.1},
}  # fmt: skip


def _roots(key, shape: str, count: int, width, thickness):
    """Evenly spread, jittered clamp points in the ferrule, (2, b) [mm], and rim distance (b,)."""
    jitter = 0.25 * jax.random.normal(key, (2, count))
    if shape in DISCS:
        index = np.arange(count) + 0.5
        angle = index * np.pi * (3.0 - np.sqrt(5.0))
        radius = np.sqrt(index / count)
        unit = jnp.asarray(np.stack([radius * np.cos(angle), radius * np.sin(angle)]))
        unit = unit + jitter / np.sqrt(count)
        rim = jnp.sqrt(jnp.sum(unit * unit, axis=0))
    else:
        # An R2 low-discrepancy sequence fills any rectangle evenly at any count.
        index = np.arange(count) + 0.5
        plastic = 1.32471795724474602596
        unit = np.stack([(index / plastic) % 1.0, (index / plastic**2) % 1.0]) * 2.0 - 1.0
        unit = jnp.clip(jnp.asarray(unit) + jitter / np.sqrt(count), -1.0, 1.0)
        rim = jnp.abs(unit[0])
    half = 0.5 * jnp.stack([jnp.asarray(width, float), jnp.asarray(thickness, float)])
    return unit, unit * half[:, None], rim


def make_brush(
    key,
    config: BrushConfig,
    shape: str = "flat",
    bristles: int = 256,
    *,
    width=None,
    thickness=None,
    length=None,
    diameter=None,
    splay=None,
    irregularity=1.0,
    modulus=HOG_MODULUS,
    friction=0.25,
    damping_ratio=0.5,
    press_depth=5.0,
    press_force=None,
) -> BrushParams:
    """A brush from its shape and measures; defaults are a hog-hair brush.

    Numbers may be traced; `shape` and `bristles` fix the arrays.

    Args:
      key: random key of the irregularity.
      config: gives the node count.
      shape: "round" and "rigger" stand in a disc, "flat", "filbert" and "fan" in a rectangle.
      bristles: count b.
      width, thickness: of the ferrule [mm].
      length: of the longest bristles [mm].
      diameter: of a bristle [mm].
      splay: angle at which the rim bristles leave the ferrule outwards [rad].
      irregularity: 0 is a perfect brush, 1 a good one, 3 an old one: direction 0.02 rad, curl
        0.06 rad and length 2 % (standard deviations) at 1.
      modulus: Young's modulus [Pa].
      friction: Coulomb coefficient between hair and (paint-lubricated) canvas.
      damping_ratio: of the first mode of the longest bristle (92 Hz for hog).
      press_depth: depth at pressure 1 [mm]. press_force: force at pressure 1 [µN]; default is
        that of all bristles as cantilevers bent by `press_depth`.

    Returns:
      BrushParams in the default float type.

    Raises:
      ValueError: an unknown shape, or a count below 1.
    """
    if shape not in SHAPES:
        raise ValueError(f"shape = {shape!r}: expected one of {SHAPES}")
    if bristles < 1:
        raise ValueError(f"bristles = {bristles}: expected at least 1")
    preset = _DEFAULTS[shape]
    width = preset["width"] if width is None else width
    thickness = preset["thickness"] if thickness is None else thickness
    length = preset["length"] if length is None else length
    diameter = preset["diameter"] if diameter is None else diameter
    splay = preset["splay"] if splay is None else splay
    n, disc = config.segments, shape in DISCS

    place, tilt, curl, cut = jax.random.split(key, 4)
    unit, root, rim = _roots(place, shape, bristles, width, thickness)
    root = jnp.concatenate([root, jnp.zeros((1, bristles))])
    own_length = length * (1.0 - preset["rim_cut"] * rim**2)
    own_length = own_length * (
        1.0 - 0.02 * irregularity * jnp.abs(jax.random.normal(cut, (bristles,)))
    )

    # Slope of a bristle outwards: splay at the ferrule, minus `point` at the tip, plus its own
    # tilt and curl.
    along = jnp.asarray((np.arange(n) + 0.5) / n)[:, None, None]
    slope = unit[None] * (splay * (1.0 - along) - preset["point"] * along)
    slope = slope + 0.02 * irregularity * jax.random.normal(tilt, (1, 2, bristles))
    slope = slope + 0.06 * irregularity * (along - 0.5) * jax.random.normal(curl, (1, 2, bristles))
    rest = jnp.concatenate([slope, jnp.full((n, 1, bristles), -1.0)], axis=1)
    rest = rest / jnp.sqrt(jnp.sum(rest * rest, axis=1, keepdims=True))

    area = 0.25 * np.pi * jnp.asarray(diameter, float) ** 2
    bending = modulus * area**2 / (4.0 * np.pi)
    density = HOG_DENSITY * area
    first_mode = 3.516 * jnp.sqrt(bending / density) / jnp.asarray(length, float) ** 2
    ones = jnp.ones(bristles)
    if press_force is None:
        press_force = bristles * 3.0 * bending / length**3 * press_depth
    return BrushParams(
        root=root,
        rest=rest,
        length=own_length,
        bending=bending * ones,
        stretch=modulus * area / AXIAL_SOFTENING * ones,
        mass=density * ones,
        damping=2.0 * damping_ratio * first_mode,
        friction=jnp.asarray(friction, float),
        press_depth=jnp.asarray(press_depth, float),
        press_force=jnp.asarray(press_force, float),
        area=jnp.asarray(width, float) * thickness * (0.25 * np.pi if disc else 1.0),
    )
