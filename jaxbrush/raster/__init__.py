"""Trajectory maps of a stroke: exact for data, soft for everything that optimises a stroke."""

from jaxbrush.raster.grid import PIXEL as PIXEL
from jaxbrush.raster.grid import Grid as Grid
from jaxbrush.raster.grid import bucket as bucket
from jaxbrush.raster.grid import dilate as dilate
from jaxbrush.raster.grid import make_grid as make_grid
from jaxbrush.raster.grid import stroke_grid as stroke_grid
from jaxbrush.raster.maps import FORCE_UNIT as FORCE_UNIT
from jaxbrush.raster.maps import WIDTH as WIDTH
from jaxbrush.raster.maps import TrajectoryMaps as TrajectoryMaps
from jaxbrush.raster.maps import trajectory_maps as trajectory_maps
