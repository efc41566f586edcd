"""Frame reports of a scene, based on commit records in memory and on disk."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from client.wire import FrameReportModel, FrameState
from scas4d_core.storage.history import History, HistoryError
from server.storage.ledger import Ledger


def first_frame_facts(record: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the parts of the first frame's commit record that the scene's status needs later.

    These are mainly the point cloud and the calibration. The result is empty for the record of any other frame.
    """
    if not (record.get("cloud") or record.get("calibration")):
        return {}
    return {name: record.get(name) for name in ("cloud", "calibration", "shortened", "grey")}


class FrameReports:
    """Frame reports of one scene; commit records that are not in memory are read from disk.

    Args:
        ledger: the scene's ledger.
        states: folder of the committed states.
        damaged: callback for unreadable files; receives the reason for each, keyed by file name.
    """

    def __init__(self, ledger: Ledger, states: Path, damaged: Callable[[Mapping[str, str]], None]) -> None:
        self._ledger = ledger
        self._states = states
        self._damaged = damaged
        self._history: History | None = None
        self._turn = threading.Lock()

    async def of(self, index: int) -> FrameReportModel | None:
        """Returns the report of a frame, or None if the frame is unknown."""
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
        self._ledger.frames.cache_record(index, record)
        return entry.report_with(record)

    async def is_committed(self, index: int) -> bool:
        """Returns whether a readable state of the frame exists on disk, regardless of the ledger."""
        return bool(await self.record(index))

    async def record(self, index: int) -> Mapping[str, Any]:
        """Reads a commit record from disk; returns an empty mapping if the state was deleted or is damaged."""
        return await asyncio.to_thread(self._read, index)

    def _read(self, index: int) -> dict[str, Any]:
        """Reads a commit record. Blocks; see `record`."""
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
