"""Bristle brushes: shapes, and the rollout of a stroke into bristle tracks."""

from jaxbrush.brush.contact import Contact, Surface
from jaxbrush.brush.forces import stable_dt
from jaxbrush.brush.rollout import BristleTrack, advance, begin, rollout
from jaxbrush.brush.shapes import SHAPES, BrushConfig, BrushParams, make_brush

__all__ = [
    "SHAPES",
    "BristleTrack",
    "BrushConfig",
    "BrushParams",
    "Contact",
    "Surface",
    "advance",
    "begin",
    "make_brush",
    "rollout",
    "stable_dt",
]
