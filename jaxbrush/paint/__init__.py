"""3D paint: brush and canvas exchange it, bristles drag it, and every pigment is conserved."""

from jaxbrush.paint.heightfield import heightfield_config as heightfield_config
from jaxbrush.paint.heightfield import heightfield_stroke as heightfield_stroke
from jaxbrush.paint.rollout import PaintReport as PaintReport
from jaxbrush.paint.rollout import paint_stroke as paint_stroke
from jaxbrush.paint.state import RELIEF as RELIEF
from jaxbrush.paint.state import BrushPaint as BrushPaint
from jaxbrush.paint.state import PaintConfig as PaintConfig
from jaxbrush.paint.state import PaintParams as PaintParams
from jaxbrush.paint.state import empty_canvas as empty_canvas
from jaxbrush.paint.state import for_brush as for_brush
from jaxbrush.paint.state import height as height
from jaxbrush.paint.state import load_brush as load_brush
from jaxbrush.paint.state import make_params as make_params
from jaxbrush.paint.state import volume as volume
from jaxbrush.paint.state import weave as weave
