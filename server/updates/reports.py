"""Reports of a scene's frames; those that are not in memory are read from disk."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from client.wire import FrameReportModel, FrameState
from scas4d_core.storage.history import History, HistoryError
from server.storage.ledger import Ledger


def of_first_report(record: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what of the first frame's report matters later: its cloud and calibration; empty of another frame's."""
    if not (record.get("cloud") or record.get("calibration")):
        return {}
    return {name: record.get(name) for name in ("cloud", "calibration", "shortened", "grey")}


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
                pictures_kept=True,
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
            return {} if self._history is None else self._history.pop_faults()
