"""Pydantic models of requests and responses, one module per resource, shared by client and service."""
# ruff: noqa: F401

from client.wire.base import MAX_CAMERAS, MAX_PIXELS_A_SIDE, CameraName, Model, Pixel, Row3, Row4
from client.wire.budgets import Budget, EffectiveBudget, SceneBudget
from client.wire.exports import WITH_IDS, ExportFormat, ExportList, ExportModel, ExportRequest, ExportState
from client.wire.frames import (
    FINISHED,
    AlarmModel,
    CalibrationModel,
    CameraFitModel,
    CameraReceipt,
    CameraResidualModel,
    CurvePointModel,
    EffectModel,
    FirstCloudModel,
    FrameLatency,
    FrameReceipt,
    FrameReportModel,
    FrameState,
    MissingRequest,
    PairsModel,
    RefinedCameraModel,
    RefinementModel,
)
from client.wire.framing import (
    FRAME_MEDIA_TYPE,
    FileKind,
    FrameBatch,
    FrameFile,
    FrameHead,
    FrameSeconds,
    FramingError,
    IngestAnswer,
    frame_chunks,
    head_length,
    parse_head,
)
from client.wire.parts import JointModel, JointsModel, PartsModel, part_colour, parts_model
from client.wire.rigs import CameraModel, RigModel
from client.wire.scenes import (
    EffectStatus,
    IngestSettings,
    PointsReceipt,
    ProgressModel,
    ReconstructionRequest,
    Retention,
    SceneCreate,
    SceneEdit,
    SceneEstimate,
    SceneList,
    SceneState,
    SceneStatus,
    StateBounds,
)
from client.wire.service import Cluster, Health, Node, ProblemDetails, Share, ShareRequest, Ticket, WaitingProcess
from client.wire.tracks import GaussianModel, GaussiansModel, TracksModel, TracksRequest, tracks_model
from client.wire.tradeoff import (
    CurveMean,
    PointKind,
    ReplayRequest,
    ReplayState,
    ReplayStatus,
    TimeModel,
    TradeoffModel,
    TradeoffPoint,
)
from client.wire.views import RenderFormat, RenderKind, RenderRequest, Unit
