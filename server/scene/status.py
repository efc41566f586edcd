"""Status of a scene: its state, effective budget, effects and cameras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from client.wire import (
    Budget,
    EffectiveBudget,
    EffectStatus,
    FrameState,
    ProgressModel,
    SceneState,
    SceneStatus,
)
from scas4d_core.cameras import Camera, Rig
from scas4d_core.effects.effect import effect
from scas4d_core.effects.switches import decode_switches, first_switches
from scas4d_core.frame_outcome import first_warnings, timing_warnings
from scas4d_core.frame_times import ROWS, time_warnings
from scas4d_core.settings import Settings
from server.keep_up import with_time_limit
from server.problems import Problem
from server.scene.new_reconstruction import restart_remedy
from server.storage.definition import Definition
from server.storage.frame_store import FrameLogIndex
from server.storage.ledger import Ledger
from server.updates.trouble import Reason


def state_of(ledger: Ledger, *, at_work: bool, degraded: bool) -> SceneState:
    """Returns the state of a scene; see `SceneStatus`."""
    if ledger.fatal is not None:
        return SceneState.FAILED
    if at_work:
        return SceneState.UPDATING if ledger.committed or ledger.states_deleted else SceneState.INITIALISING
    if ledger.paused:
        return SceneState.PAUSED
    if degraded:
        return SceneState.DEGRADED
    if ledger.next_frame <= ledger.frames.first and not ledger.open:
        return SceneState.AWAITING
    return SceneState.READY


@dataclass(frozen=True, kw_only=True)
class SceneFacts:
    """Data used to compute a scene's status.

    Attributes:
        definition: scene definition.
        ledger: the scene's ledger.
        pictures: index of the scene's frame log.
        has_points: whether the scene has an initial point cloud.
        queue_limit: maximum number of queued frames.
        first: facts about the first frame; see `first_frame_facts`.
        damage: messages about damaged files.
        warnings: warnings about the rig.
        trouble: reason why the scene is degraded, or None.
        at_work: whether a frame is being processed.
        behind_seconds: seconds since the oldest unfinished frame was received.
        progress: progress of the first frame while it is being reconstructed, or of the compilation
            of kernels before an update; otherwise None.
        worker_deaths: number of worker crashes since the scene was loaded.
        asleep: whether the scene has no slot and therefore no processes.
    """

    definition: Definition
    ledger: Ledger
    pictures: FrameLogIndex
    has_points: bool
    queue_limit: int
    first: Mapping[str, Any]
    damage: list[str]
    warnings: list[str]
    trouble: Reason | None
    at_work: bool = False
    behind_seconds: float = 0.0
    progress: ProgressModel | None = None
    worker_deaths: int = 0
    asleep: bool = False

    @property
    def error(self) -> str | None:
        """Reason why the scene has failed or is degraded, or None."""
        fatal = self.ledger.fatal
        if fatal is None:
            return None if self.trouble is None else self.trouble.sentence
        return f"{fatal}; {restart_remedy(self.ledger)}"

    @property
    def state(self) -> SceneState:
        """State of the scene; see `SceneStatus`."""
        return state_of(self.ledger, at_work=self.at_work, degraded=self.error is not None)

    def status(self) -> SceneStatus:
        """Returns the status of the scene as a model of the HTTP API."""
        ledger, request, settings = self.ledger, self.definition.request, self.definition.settings
        committed, counts = ledger.committed, ledger.counts
        entry = ledger.frames.get(committed[-1]) if committed else None
        newest: Mapping[str, Any] = (None if entry is None else entry.record) or {}
        return SceneStatus(
            id=self.definition.id,
            name=ledger.edited.name if ledger.edited.name is not None else request.name,
            state=self.state,
            error=self.error,
            progress=self.progress,
            cameras=[camera.name for camera in request.rig.cameras],
            has_points=self.has_points,
            next_frame=ledger.next_frame,
            queued=ledger.unfinished,
            queue_limit=self.queue_limit,
            behind_seconds=round(self.behind_seconds, 3),
            committed=len(committed),
            first_committed=committed[0] if committed else None,
            last_committed=committed[-1] if committed else None,
            gaussians=newest.get("gaussians"),
            reconstruction=ledger.reconstruction,
            first_frame=ledger.frames.first,
            paused=ledger.paused,
            asleep=self.asleep,
            archived=bool(ledger.edited.archived),
            degraded=self.trouble is not None and ledger.fatal is None,
            lost_cameras=self.trouble is not None and self.trouble.lost_cameras and ledger.fatal is None,
            open_frames=sorted(ledger.open),
            failed=counts[FrameState.FAILED],
            missing=counts[FrameState.MISSING],
            skipped=counts[FrameState.SKIPPED],
            worker_deaths=self.worker_deaths,
            frames_kept=len(self.pictures),
            frames_deleted=ledger.frames.pictures_deleted,
            frame_bytes=self.pictures.bytes,
            states_deleted=ledger.states_deleted,
            effects=effects_of(settings, newest or None),
            damage=self.damage,
            warnings=[
                *self.warnings,
                *time_warnings(ledger.times_before(ledger.next_frame, ROWS), request.frames_per_second),
                *first_warnings(self.first),
                *timing_warnings(newest.get("timing")),
            ],
            created=self.definition.created.isoformat(),
            ingest=ledger.edited.rules(request.ingest),
            nodes=request.nodes,
            settings=settings.model_dump(mode="json"),
            budget=ledger.budgets[-1][1],
        )


def effective_budget(settings: Settings, asked: Budget) -> EffectiveBudget:
    """Returns a budget with missing fields filled in from the scene's settings."""
    limited = with_time_limit(asked, waiting=0)
    fields = {name: getattr(settings.update, name, None) if value is None else value for name, value in limited}
    return EffectiveBudget(**fields)


def effects_of(settings: Settings, record: Mapping[str, Any] | None) -> dict[str, EffectStatus]:
    """Returns the status of each effect of a scene.

    Args:
        settings: scene settings.
        record: newest commit record. If it is None or has no effects, the initial switches are used.
    """
    switches = decode_switches((record or {}).get("effects", {})) or first_switches(settings, 0)
    return {
        name: EffectStatus(**asdict(switch), group=effect(name).group, description=effect(name).description)
        for name, switch in switches.items()
    }


def camera_of(rig: Rig, name: str) -> Camera:
    """Returns a camera of the rig by name.

    Raises:
        Problem: 422 if the rig has no camera of that name.
    """
    if name not in rig.names:
        raise Problem(
            422,
            f"the rig has no camera {name!r}",
            field="camera",
            value=name,
            remedy=f"use one of {', '.join(rig.names)}, or specify a complete camera",
        )
    return rig[name]
