"""A virtual brush and thick 3D paint in JAX.

A stylus stroke drives a brush of simulated bristles; the bristles drive a 3D paint simulator,
and networks trained on its strokes paint the same stroke in real time. Every stage is a pure
function that composes with `jit`, `vmap` and `grad`.
"""

from jaxbrush.platform import check_jax_version

__version__ = "0.1.0"

check_jax_version()

from jaxbrush.brush import SHAPES as SHAPES  # noqa: E402
from jaxbrush.brush import BristleTrack as BristleTrack  # noqa: E402
from jaxbrush.brush import BrushConfig as BrushConfig  # noqa: E402
from jaxbrush.brush import BrushParams as BrushParams  # noqa: E402
from jaxbrush.brush import Surface as Surface  # noqa: E402
from jaxbrush.brush import make_brush as make_brush  # noqa: E402
from jaxbrush.brush import rollout as rollout  # noqa: E402
from jaxbrush.brush import stable_dt as stable_dt  # noqa: E402
from jaxbrush.models import Discriminator as Discriminator  # noqa: E402
from jaxbrush.models import DiscriminatorConfig as DiscriminatorConfig  # noqa: E402
from jaxbrush.models import Generator as Generator  # noqa: E402
from jaxbrush.models import GeneratorConfig as GeneratorConfig  # noqa: E402
from jaxbrush.painter import Nets as Nets  # noqa: E402
from jaxbrush.painter import PainterConfig as PainterConfig  # noqa: E402
from jaxbrush.painter import load_nets as load_nets  # noqa: E402
from jaxbrush.painter import paint_on as paint_on  # noqa: E402
from jaxbrush.painter import paint_stroke as paint_stroke  # noqa: E402
from jaxbrush.painter import preview_stroke as preview_stroke  # noqa: E402
from jaxbrush.raster import Grid as Grid  # noqa: E402
from jaxbrush.raster import TrajectoryMaps as TrajectoryMaps  # noqa: E402
from jaxbrush.raster import make_grid as make_grid  # noqa: E402
from jaxbrush.raster import stroke_grid as stroke_grid  # noqa: E402
from jaxbrush.raster import trajectory_maps as trajectory_maps  # noqa: E402
from jaxbrush.stylus import Stroke as Stroke  # noqa: E402
from jaxbrush.stylus import make_stroke as make_stroke  # noqa: E402
from jaxbrush.stylus import random_stroke as random_stroke  # noqa: E402
from jaxbrush.stylus import resample as resample  # noqa: E402
from jaxbrush.stylus import transform as transform  # noqa: E402
from jaxbrush.train import Batch as Batch  # noqa: E402
from jaxbrush.train import TrainConfig as TrainConfig  # noqa: E402
from jaxbrush.train import TrainParams as TrainParams  # noqa: E402
from jaxbrush.train import make_params as make_params  # noqa: E402
from jaxbrush.train import make_train as make_train  # noqa: E402
