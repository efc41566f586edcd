"""A first cloud from the pictures of frame 0: triangulation, visual hull, stereo and fitted surfaces."""

from scas4d_core.initial_points.cloud import initial_points
from scas4d_core.initial_points.settings import InitialPointsSettings
from scas4d_core.initial_points.views import InitialPointsError

__all__ = ["InitialPointsError", "InitialPointsSettings", "initial_points"]
