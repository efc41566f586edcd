"""Answers questions about a scene: its state, its budget, its cameras, its committed frames and their reports."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from client.wire import (
    Budget,
    EffectiveBudget,
    EffectStatus,
    FrameReportModel,
    FrameState,
    ProgressModel,
    SceneState,
    SceneStatus,
)
from scas4d_core.cameras import Camera, Rig
from scas4d_core.effects.effect import effect
from scas4d_core.effects.switches import first_switches, switches_of
from scas4d_core.frame_outcome import first_warnings, timing_warnings
from scas4d_core.settings import Settings
from scas4d_core.storage.history import History, HistoryError
from server.problems import Problem
from server.scene.beginning import how_to_begin_again
from server.storage.definition import Definition
from server.storage.frame_store import FrameLogIndex
from server.storage.ledger import Ledger


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
    """All that the status of a scene is made of.

    Attributes:
        definition, ledger, pictures: of the scene. has_points: it has an initial cloud. queue_limit: in frames.
        first: see `of_first_report`. damage, warnings: sentences; the warnings, about the rig.
        trouble: why it is degraded, or None. at_work: a frame is. progress: of frame 0, while it is at work.
        worker_deaths: since it was taken up. asleep: it has no place among those that may have processes.
    """

    definition: Definition
    ledger: Ledger
    pictures: FrameLogIndex
    has_points: bool
    queue_limit: int
    first: Mapping[str, Any]
    damage: list[str]
    warnings: list[str]
    trouble: str | None
    at_work: bool = False
    progress: ProgressModel | None = None
    worker_deaths: int = 0
    asleep: bool = False

    @property
    def error(self) -> str | None:
        """Sentence that says why the scene is failed or degraded, or None."""
        fatal = self.ledger.fatal
        return self.trouble if fatal is None else f"{fatal}; {how_to_begin_again(self.ledger)}"

    @property
    def state(self) -> SceneState:
        """State of the scene; see `SceneStatus`."""
        return state_of(self.ledger, at_work=self.at_work, degraded=self.error is not None)

    def status(self) -> SceneStatus:
        """Describes the scene."""
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
            committed=len(committed),
            first_committed=committed[0] if committed else None,
            last_committed=committed[-1] if committed else None,
            gaussians=newest.get("gaussians"),
            reconstruction=ledger.reconstruction,
            first_frame=ledger.frames.first,
            paused=ledger.paused,
            asleep=self.asleep,
            archived=bool(ledger.edited.archived),
            degraded=self.error is not None and ledger.fatal is None,
            open_frames=sorted(ledger.open),
            set_aside=counts[FrameState.SET_ASIDE],
            missing=counts[FrameState.MISSING],
            skipped=counts[FrameState.SKIPPED],
            worker_deaths=self.worker_deaths,
            frames_held=len(self.pictures),
            frame_bytes=self.pictures.bytes,
            states_deleted=ledger.states_deleted,
            effects=effects_of(settings, newest or None),
            damage=self.damage,
            warnings=[*self.warnings, *first_warnings(self.first), *timing_warnings(newest.get("timing"))],
            created=self.definition.created.isoformat(),
            ingest=ledger.edited.rules(request.ingest),
            nodes=request.nodes,
            settings=settings.model_dump(mode="json"),
            budget=ledger.budgets[-1][1],
        )


def trouble_of(report: FrameReportModel) -> str | None:
    """Says why a scene is degraded whose newest finished frame has this report; None: it is not."""
    if report.state == FrameState.SET_ASIDE:
        return f"frame {report.index} was set aside: {report.error}"
    if report.outcome is not None and report.outcome.degraded:
        verb = "" if report.outcome.held else "committed in part: "
        return f"frame {report.index} was {verb}{report.degraded}"
    if report.dropped_cameras:
        left_out = "; ".join(f"{name}: {reason}" for name, reason in report.dropped_cameras.items())
        return f"frame {report.index} was committed without camera {left_out}"
    return None


def last_trouble(ledger: Ledger) -> str | None:
    """Says what went wrong with the newest frame that was tried, or None."""
    last = ledger.last_tried()
    return None if last is None else trouble_of(ledger.frames[last].report)


def of_first_report(record: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what of the first frame's report matters later: its cloud and calibration; empty of another frame's."""
    if not (record.get("cloud") or record.get("calibration")):
        return {}
    return {name: record.get(name) for name in ("cloud", "calibration", "shortened", "grey")}


def effective_budget(settings: Settings, asked: Budget) -> EffectiveBudget:
    """Fills the open fields of a budget from the settings of the scene."""
    fields = {name: getattr(settings.update, name) if value is None else value for name, value in asked}
    return EffectiveBudget(**fields)


def effects_of(settings: Settings, record: Mapping[str, Any] | None) -> dict[str, EffectStatus]:
    """Describes the effects of a scene.

    Args:
        record: of the newest commit; None, or one that says nothing of effects: as before the first frame.
    """
    switches = switches_of((record or {}).get("effects", {})) or first_switches(settings, 0)
    return {
        name: EffectStatus(**asdict(switch), group=effect(name).group, says=effect(name).says)
        for name, switch in switches.items()
    }


def camera_of(rig: Rig, name: str) -> Camera:
    """Returns a camera of the rig by name.

    Raises:
        Problem: 422, the rig has none of that name.
    """
    if name not in rig.names:
        raise Problem(
            422,
            f"the rig has no camera {name!r}",
            field="camera",
            value=name,
            remedy=f"name one of {', '.join(rig.names)}, or give the camera itself",
        )
    return rig[name]


class FrameReports:
    """Reports of a scene's frames; records of commits that are not in memory are read from disk.

    Args:
        ledger: of the scene. states: folder of its committed states.
        damaged: called with files that could not be read, by name with the reason.
    """

    def __init__(self, ledger: Ledger, states: Path, damaged: Callable[[Mapping[str, str]], None]) -> None:
        self._ledger = ledger
        self._states = states
        self._damaged = damaged
        self._history: History | None = None
        self._turn = threading.Lock()

    async def of(self, index: int) -> FrameReportModel | None:
        """Returns the report of a frame; None where the frame is not known."""
        entry = self._ledger.frames.get(index)
        if entry is None:
            parts = self._ledger.open.get(index)
            if parts is None:
                return None
            return FrameReportModel(
                scene=self._ledger.scene,
                index=index,
                time=parts.time,
                state=FrameState.OPEN,
                received=parts.cameras,
                held=True,
            )
        if entry.state != FrameState.COMMITTED or entry.deleted or entry.record is not None:
            return entry.report
        record = await asyncio.to_thread(self._read, index)
        if damaged := await asyncio.to_thread(self._take_faults):
            self._damaged(damaged)
        self._ledger.frames.remember(index, record)
        return entry.report_with(record)

    async def is_committed(self, index: int) -> bool:
        """Returns whether a readable state of the frame is on disk, whatever the ledger says."""
        return bool(await self.record(index))

    async def record(self, index: int) -> Mapping[str, Any]:
        """Reads the record of a commit from disk; empty where its state is deleted or damaged."""
        return await asyncio.to_thread(self._read, index)

    def _read(self, index: int) -> dict[str, Any]:
        """Reads the record of a commit; empty where its state is deleted or damaged."""
        with self._turn:
            try:
                if self._history is None:
                    self._history = History.load(self._states, only=(index,))
                else:
                    self._history.refresh(only=(index,))
                return self._history.report(index)
            except HistoryError:
                return {}

    def _take_faults(self) -> dict[str, str]:
        with self._turn:
            return {} if self._history is None else self._history.take_faults()
