"""Answers questions about a scene: its state, its budget, its cameras, its committed frames and their reports."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from client.wire import Budget, EffectiveBudget, EffectStatus, FrameReportModel, FrameState, SceneState
from scas4d_core.cameras import Camera, Rig
from scas4d_core.effects.effect import effect
from scas4d_core.effects.switches import first_switches, switches_of
from scas4d_core.settings import Settings
from scas4d_core.storage.history import History, HistoryError
from server.problems import Problem
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
