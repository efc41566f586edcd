"""What crosses the wire, once: the service imports these models, the SDK returns them. One file a resource."""

from client.wire.base import MAX_CAMERAS, MAX_PIXELS_A_SIDE, CameraName, Model, Pixel, Row3, Row4
from client.wire.frames import (
    FINISHED,
    CameraFitModel,
    FrameReceipt,
    FrameReportModel,
    FrameState,
    MissingRequest,
    PartReceipt,
)
from client.wire.framing import (
    FRAME_MEDIA_TYPE,
    FileKind,
    FrameFile,
    FrameHead,
    FramingError,
    IngestAnswer,
    frame_chunks,
    head_length,
    parse_frame,
    parse_head,
)
from client.wire.parts import PartsModel, part_colour, parts_model
from client.wire.rigs import CameraModel, RigModel
from client.wire.scenes import (
    IngestSettings,
    PointsReceipt,
    ProgressModel,
    Retention,
    SceneCreate,
    SceneList,
    SceneState,
    SceneStatus,
)
from client.wire.service import Health, ProblemDetails, Ticket
from client.wire.tracks import TracksModel, TracksRequest, tracks_model
from client.wire.views import RenderFormat, RenderKind, RenderRequest, Unit

__all__ = [
    "FINISHED",
    "FRAME_MEDIA_TYPE",
    "MAX_CAMERAS",
    "MAX_PIXELS_A_SIDE",
    "CameraFitModel",
    "CameraModel",
    "CameraName",
    "FileKind",
    "FrameFile",
    "FrameHead",
    "FrameReceipt",
    "FrameReportModel",
    "FrameState",
    "FramingError",
    "Health",
    "IngestAnswer",
    "IngestSettings",
    "MissingRequest",
    "Model",
    "PartReceipt",
    "PartsModel",
    "Pixel",
    "PointsReceipt",
    "ProblemDetails",
    "ProgressModel",
    "RenderFormat",
    "RenderKind",
    "RenderRequest",
    "Retention",
    "RigModel",
    "Row3",
    "Row4",
    "SceneCreate",
    "SceneList",
    "SceneState",
    "SceneStatus",
    "Ticket",
    "TracksModel",
    "TracksRequest",
    "Unit",
    "frame_chunks",
    "head_length",
    "parse_frame",
    "parse_head",
    "part_colour",
    "parts_model",
    "tracks_model",
]
