"""Reads the committed frames of a scene with their times, reports and event logs. Requires only NumPy."""

from __future__ import annotations

import json
from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from itertools import islice, takewhile
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from scas4d_core.gaussians import FIXED
from scas4d_core.storage.births import NO_EVENTS, Int
from scas4d_core.storage.faults import DamagedFrameError, HistoryError, OtherFormatError, UnreadableFrameError
from scas4d_core.storage.frame_arrays import EFFECTS, EVENTS, Arrays, unpack_effects
from scas4d_core.storage.frame_files import FrameFiles, frame_file
from scas4d_core.storage.frame_maps import FrameStamps, FrameTimes

FRAMES_KEPT = 4
"""Number of frames of an on-disk history that are cached in memory: the newest and the most recently read ones."""


class FramesReader:
    """Reader for committed frames, in the memory of this process or in a directory to which another process writes.

    Args:
        directory: folder of the states, or None for a history in memory.

    Attributes:
        damaged: maps each unreadable frame to the reason; these frames are not in ``indices``.
    """

    def __init__(self, directory: Path | None = None) -> None:
        self._files = None if directory is None else FrameFiles(directory)
        self.damaged: dict[int, str] = {}
        self._fixed: Arrays = {}
        self._background: tuple[float, float, float] | None = None
        self._times = FrameTimes()
        self._stamps = FrameStamps()
        self._texts: dict[int, bytes] = {}
        """JSON reports of the frames in memory, keyed by frame."""
        self._scratch_reports: dict[int, Mapping[str, NDArray[np.uint8]]] = {}
        """Reports of frames moved to a scratch file (``History.move_to_scratch``)."""
        self._packed: dict[int, NDArray[np.uint8]] = {}
        """Packed effect arrays of frames that were written by this process and are in memory."""
        self._frames: OrderedDict[int, Mapping[str, NDArray[Any]]] = OrderedDict()
        self._births: dict[int, Arrays] = {}
        """Arrays of the births of each frame, including truncated frames."""
        self._log: tuple[int, Int] = (-1, NO_EVENTS)
        """Index of the newest frame, and its event log."""
        self._grown: tuple[list[tuple[int, int, int]], Arrays] = ([], {})
        """Cached list of births, and the fixed arrays of all Gaussians after these births."""

    @classmethod
    def load(cls, directory: Path | str, only: Iterable[int] | None = None) -> Self:
        """Opens the history in a directory. Unreadable frames are listed in ``damaged`` instead of ``indices``.

        Args:
            directory: directory of the history.
            only: indices of the frames to read; if None, every file in the directory is checked.

        Raises:
            HistoryError: if there is no history, or the file that all frames need is damaged.
            OtherFormatError: if the folder, or a compact file in it, has an unsupported format.
        """
        files = FrameFiles(Path(directory))
        if not files.exists:
            raise HistoryError(f"{files.directory.name} contains no history: {files.fixed.name} is missing")
        files.require_format()
        history = cls()
        history._files = files
        history.refresh(only)
        if foreign := files.chunks.foreign:
            raise OtherFormatError("; ".join(foreign))
        if history._stamps:
            history._fixed = files.read_fixed()
        return history

    def refresh(self, only: Iterable[int] | None = None) -> tuple[list[int], list[int]]:
        """Reads the changes made by the process that writes to this directory, without reopening unchanged frames.

        Args:
            only: indices of frames that may have changed. If None, all states are listed, which is slow for long
                scenes.

        Returns:
            The indices of new or rewritten frames, and the indices of deleted frames.
        """
        if self._files is None:
            return [], []
        looked_at = {*self._times, *self.damaged} if only is None else set(only)
        listed = self._files.list_stamps() if only is None else self._files.stamps_of(looked_at)
        gone = sorted(index for index in looked_at if index in self._times and index not in listed)
        changed = [index for index, stamp in listed.items() if self._stamps.get(index) != stamp]
        for index in [*gone, *changed]:
            self._forget(index)
        for index in looked_at - listed.keys():
            self.damaged.pop(index, None)
        added = []
        for index in changed:
            try:
                self._times[index] = self._files.time(index, listed[index])
            except FileNotFoundError:  # deleted after it was listed
                continue
            except ValueError as error:
                self.damaged[index] = str(error)
            else:
                self.damaged.pop(index, None)
                added.append(index)
            self._stamps[index] = listed[index]
        if added and not self._fixed:
            self._fixed = self._files.read_fixed()
        return added, gone

    def older_than_newest(self, newest: int, after: int) -> list[int]:
        """Returns the frames after ``after`` in increasing order, except the first and the ``newest`` latest frames."""
        first = next(iter(self._times), -1)
        frames = takewhile(lambda index: index > max(after, first), islice(reversed(self._times), newest, None))
        return list(frames)[::-1]

    @property
    def damaged_chunks(self) -> list[str]:
        """One sentence for each damaged compact file with frames that are missing from ``indices``."""
        return [] if self._files is None else self._files.chunks.damaged

    def is_compacted(self, index: int) -> bool:
        """Returns whether a committed frame is stored in a chunk."""
        return index in self._times and self._files is not None and self._files.is_compacted(index)

    def mark_compacted(self, index: int) -> None:
        """Records that a frame was moved to a chunk, and discards the cached original."""
        if self._files is not None and index in self._times and (stamp := self._files.chunks.stamp(index)) is not None:
            self._stamps[index] = stamp
            for kept in (self._frames, self._texts, self._packed):
                kept.pop(index, None)

    def pop_faults(self) -> dict[str, str]:
        """Returns the problem with each file found damaged or missing since the last call, keyed by file name."""
        if self._files is None:
            return {}
        faults, self._files.faults = self._files.faults, {}
        return faults

    @property
    def directory(self) -> Path | None:
        """Directory of the states, or None for a history in memory."""
        return None if self._files is None else self._files.directory

    def __len__(self) -> int:
        return len(self._times)

    def __contains__(self, index: object) -> bool:
        return index in self._times

    @property
    def indices(self) -> list[int]:
        """Indices of the committed frames, in increasing order."""
        return list(self._times)

    @property
    def times(self) -> NDArray[np.float64]:
        """[T] float64 times in seconds, in the order of ``indices``."""
        return np.array(self._times.column(), dtype=np.float64)

    @property
    def files(self) -> FrameFiles | None:
        """Files on disk, for repairs (``scas4d_core.recompute``), or None for a history in memory."""
        return self._files

    def time(self, index: int) -> float:
        """Returns the time of a committed frame in seconds."""
        self._require(index)
        return self._times[index]

    def report(self, index: int) -> dict[str, Any]:
        """Returns the report committed with a frame, or an empty dict if there was none.

        Raises:
            HistoryError: if the frame was not committed, or its file is damaged.
        """
        self._require(index)
        text = self._texts.get(index)
        if text is None:
            kept = self._scratch_reports.get(index)
            text = (self._from_file(index, ("report",)) if kept is None else kept)["report"].tobytes()
        try:
            report: dict[str, Any] = json.loads(text)
        except ValueError as error:
            raise HistoryError(f"{frame_file(index)}: the report is not valid JSON ({error})") from error
        if index in self._frames and index not in self._scratch_reports:
            self._texts[index] = text
        return report

    @property
    def first_report(self) -> dict[str, Any]:
        """Report of the first frame, or an empty dict if it does not exist or cannot be read."""
        with suppress(HistoryError):
            return self.report(next(iter(self._times))) if self._times else {}
        return {}

    @property
    def background(self) -> tuple[float, float, float]:
        """Background colour, RGB in [0, 1], as estimated in frame 0, or black if its report contains none.

        Raises:
            HistoryError: if the file of frame 0 and its copy are damaged.
        """
        if self._background is None and self._times:
            given = self.report(next(iter(self._times))).get("background")
            if given is None:  # the report was lost
                return 0.0, 0.0, 0.0
            red, green, blue = given
            self._background = (red, green, blue)
        return self._background or (0.0, 0.0, 0.0)

    def effects(self, index: int) -> dict[str, Arrays]:
        """Returns the effect arrays of a committed frame for a cold start, keyed by effect and array name.

        The result is empty if the frame has no such arrays, or if they cannot be read.
        """
        return unpack_effects(self._left(index))

    def _left(self, index: int) -> NDArray[np.uint8] | None:
        """Returns the packed effect arrays of a frame, or None if there are none or they cannot be read."""
        self._require(index)
        left = self._packed.get(index)
        if left is None and self._files is not None:
            with suppress(FileNotFoundError, UnreadableFrameError):  # the state may still be intact
                left = self._files.read(index, (), (EFFECTS,)).get(EFFECTS)
        return left

    def _events(self) -> Int:
        """Returns the event log [E, 4] of the newest readable frame."""
        while (newest := self.newest_index) >= 0:
            known, log = self._log
            if known > newest or (known >= 0 and self._files is None):  # frames have since been truncated
                log = log[log[:, 0] <= newest]
            elif known < newest:
                try:
                    log = self._from_file(newest, (), (EVENTS,)).get(EVENTS, NO_EVENTS)
                except UnreadableFrameError:
                    continue  # the frame was dropped; the log of the previous one lacks only its events
            self._log = (newest, log)
            return log
        return NO_EVENTS

    def log_at(self, index: int) -> Int:
        """Returns the event log up to and including a frame."""
        log = self._events()
        return log[log[:, 0] <= index] if len(log) else log

    def _fixed_after(self, births: list[tuple[int, int, int]]) -> Arrays:
        """Returns the ``FIXED`` arrays of all Gaussians after the given births."""
        if not births:
            return self._fixed
        known, arrays = self._grown
        if births != known[: len(births)]:
            parts = [self._fixed, *map(self._born, births)]
            arrays = {name: np.concatenate([part[name] for part in parts]) for name in FIXED}
            self._grown = births, arrays
        count = len(self._fixed["ids"]) + sum(last - first + 1 for _, first, last in births)
        return {name: array[:count] for name, array in arrays.items()}

    def _born(self, birth: tuple[int, int, int]) -> Arrays:
        """Returns the stored arrays of a birth, which is given as (frame, first id, last id)."""
        index, first, last = birth
        known = self._births.get(index)
        if self._files is not None and (known is None or known["ids"][0] != first):
            try:
                self._births[index] = known = self._files.read_born(index)
            except UnreadableFrameError as error:
                raise DamagedFrameError(str(error)) from error
        if known is None or (known["ids"][0], known["ids"][-1]) != (first, last):
            raise DamagedFrameError(
                f"Gaussians {first} to {last}, which were born in frame {index}, do not match those on disk"
            )
        return known

    def _require(self, index: int) -> None:
        if index in self._times:
            return
        if index in self.damaged:
            raise DamagedFrameError(f"frame {index} cannot be read: {self.damaged[index]}")
        held = f"{next(iter(self._times))} to {self.newest_index}" if self._times else "none yet"
        raise UnreadableFrameError(f"frame {index} is not in the history; committed frames: {held}")

    @property
    def newest_index(self) -> int:
        """Index of the newest frame, or −1 if there is none. Unlike ``indices``, it copies nothing."""
        return next(reversed(self._times), -1)

    def _from_file(self, index: int, names: Sequence[str], optional: Sequence[str] = ()) -> Arrays:
        assert self._files is not None
        try:
            return self._files.read(index, names, optional)
        except FileNotFoundError:
            self._forget(index)  # deleted by the appending process or by another
            self._files.faults[self._files.path(index).name] = f"{self._files.path(index).name} is missing"
            self._require(index)
            raise
        except UnreadableFrameError as error:
            stamp = self._stamps.get(index)
            self._forget(index)
            self.damaged[index] = str(error)
            if stamp is not None:  # do not retry until the file changes
                self._stamps[index] = stamp
            raise DamagedFrameError(str(error)) from error

    def _forget(self, index: int) -> None:
        self._times.pop(index, None)
        self._scratch_reports.pop(index, None)
        self._stamps.pop(index, None)
        self._texts.pop(index, None)
        self._packed.pop(index, None)
        self._frames.pop(index, None)
        if self._files is not None and self._log[0] == index:
            self._log = (-1, NO_EVENTS)

    def _keep(self, index: int, frame: Arrays) -> None:
        self._frames[index] = frame
        if self._files is not None:
            newest = self.newest_index
            for old in [i for i in self._frames if i != newest][: max(0, len(self._frames) - FRAMES_KEPT)]:
                del self._frames[old]
                self._texts.pop(old, None)
                self._packed.pop(old, None)
