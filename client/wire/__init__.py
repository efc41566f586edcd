"""What crosses the wire, once: the service imports these models, the SDK returns them. One file a resource."""

from client.wire.base import MAX_CAMERAS, MAX_PIXELS_A_SIDE, CameraName, Model, Pixel, Row3, Row4
from client.wire.frames import FrameReceipt, FrameReportModel, FrameState
from client.wire.parts import PartsModel
from client.wire.rigs import CameraModel, RigModel
from client.wire.scenes import PointsReceipt, ProgressModel, SceneCreate, SceneList, SceneState, SceneStatus
from client.wire.service import Health, ProblemDetails
from client.wire.tracks import TracksModel, TracksRequest, tracks_model
from client.wire.views import RenderFormat, RenderKind, RenderRequest, Unit

__all__ = [
    "MAX_CAMERAS",
    "MAX_PIXELS_A_SIDE",
    "CameraModel",
    "CameraName",
    "FrameReceipt",
    "FrameReportModel",
    "FrameState",
    "Health",
    "Model",
    "PartsModel",
    "Pixel",
    "PointsReceipt",
    "ProblemDetails",
    "ProgressModel",
    "RenderFormat",
    "RenderKind",
    "RenderRequest",
    "RigModel",
    "Row3",
    "Row4",
    "SceneCreate",
    "SceneList",
    "SceneState",
    "SceneStatus",
    "TracksModel",
    "TracksRequest",
    "Unit",
    "tracks_model",
]
