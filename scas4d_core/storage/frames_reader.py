"""Reads which frames of a scene are committed, when, with which report, and after which births. Numpy only."""

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
from scas4d_core.storage.frame_arrays import EFFECTS, EVENTS, Arrays, Stamp, unpack_effects
from scas4d_core.storage.frame_files import FrameFiles, frame_file

FRAMES_KEPT = 4
"""Frames of a history on disk that stay in memory: the newest, and the last ones read."""


class FramesReader:
    """The committed frames, in the memory of this process or in a directory that another process writes.

    Attributes:
        damaged: frames whose file cannot be read, with the reason; they are not among ``indices``.
    """

    def __init__(self, directory: Path | None = None) -> None:
        self._files = None if directory is None else FrameFiles(directory)
        self.damaged: dict[int, str] = {}
        self._fixed: Arrays = {}
        self._background: tuple[float, float, float] | None = None
        self._times: dict[int, float] = {}
        self._stamps: dict[int, Stamp] = {}
        self._texts: dict[int, bytes] = {}
        """Reports of the frames that are in memory."""
        self._scratch_reports: dict[int, Mapping[str, NDArray[np.uint8]]] = {}
        """Those of frames without a file that are not (``History.move_to_scratch``)."""
        self._packed: dict[int, NDArray[np.uint8]] = {}
        """What effects left of the frames that were written here and are in memory, packed."""
        self._frames: OrderedDict[int, Mapping[str, NDArray[Any]]] = OrderedDict()
        self._births: dict[int, Arrays] = {}
        """What is known of the born, by frame; those of frames that were taken back stay."""
        self._log: tuple[int, Int] = (-1, NO_EVENTS)
        """The newest frame and its log."""
        self._grown: tuple[list[tuple[int, int, int]], Arrays] = ([], {})
        """Births, and the fixed arrays of all Gaussians after them."""

    @classmethod
    def load(cls, directory: Path | str, only: Iterable[int] | None = None) -> Self:
        """Opens the history in a directory. A frame that cannot be read is left out and named in ``damaged``.

        Args:
            directory: of the history.
            only: the frames that are read, where these are known; else every file of the directory is looked at.

        Raises:
            HistoryError: no history there, or the file that all frames need is damaged. OtherFormatError: the folder,
                or a compact file in it, is of another format.
        """
        files = FrameFiles(Path(directory))
        if not files.exists:
            raise HistoryError(f"{files.directory.name} holds no history: {files.fixed.name} is missing")
        files.require_format()
        history = cls()
        history._files = files
        history.refresh(only)
        if foreign := files.chunks.foreign:
            raise OtherFormatError("; ".join(foreign))
        if history._stamps:
            history._fixed = files.read_fixed(FIXED)
        return history

    def refresh(self, only: Iterable[int] | None = None) -> tuple[list[int], list[int]]:
        """Picks up what the process that writes this directory has committed and deleted; known frames stay unopened.

        Args:
            only: the frames that may have changed, where these are known: listing the states of a day takes a while.

        Returns:
            The indices that are new (or written anew), and those that are gone.
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
        newest = self._newest()
        added = []
        for index in changed:
            try:
                self._times[index] = self._files.time(index, listed[index])
            except FileNotFoundError:  # deleted since it was listed
                continue
            except ValueError as error:
                self.damaged[index] = str(error)
            else:
                self.damaged.pop(index, None)
                added.append(index)
            self._stamps[index] = listed[index]
        if added and added[0] < newest:
            self._times = dict(sorted(self._times.items()))
        if added and not self._fixed:
            self._fixed = self._files.read_fixed(FIXED)
        return added, gone

    def older_than_newest(self, newest: int, after: int) -> list[int]:
        """The frames after one that are older than so many newest, rising, without the first of all."""
        first = next(iter(self._times), -1)
        frames = takewhile(lambda index: index > max(after, first), islice(reversed(self._times), newest, None))
        return list(frames)[::-1]

    @property
    def damaged_chunks(self) -> list[str]:
        """A sentence for each compact file that is damaged so that frames of it are not among ``indices``."""
        return [] if self._files is None else self._files.chunks.damaged

    def is_compacted(self, index: int) -> bool:
        """True for a committed frame that is in a chunk by now."""
        return index in self._times and self._files is not None and self._files.is_compacted(index)

    def mark_compacted(self, index: int) -> None:
        """Notes that the state of a frame went to a chunk, from which it is read from now on."""
        if self._files is not None and index in self._times and (stamp := self._files.chunks.stamp(index)) is not None:
            self._stamps[index] = stamp
            for kept in (self._frames, self._texts, self._packed):
                kept.pop(index, None)

    def pop_faults(self) -> dict[str, str]:
        """Files found damaged or gone since the last call, by name with the reason."""
        if self._files is None:
            return {}
        faults, self._files.faults = self._files.faults, {}
        return faults

    @property
    def directory(self) -> Path | None:
        """Directory of the states; None in memory."""
        return None if self._files is None else self._files.directory

    def __len__(self) -> int:
        return len(self._times)

    def __contains__(self, index: object) -> bool:
        return index in self._times

    @property
    def indices(self) -> list[int]:
        """The committed frame numbers, rising."""
        return list(self._times)

    @property
    def times(self) -> NDArray[np.float64]:
        """[T] float64 seconds, in the order of ``indices``."""
        return np.array(list(self._times.values()), dtype=np.float64)

    @property
    def files(self) -> FrameFiles | None:
        """The files on disk, to mend them (``scas4d_core.recompute``); None in memory."""
        return self._files

    def time(self, index: int) -> float:
        """Seconds of one committed frame."""
        self._require(index)
        return self._times[index]

    def report(self, index: int) -> dict[str, Any]:
        """The report that was committed with the state of a frame; empty where there was none.

        Raises:
            HistoryError: the frame was not committed, or its file is damaged.
        """
        self._require(index)
        text = self._texts.get(index)
        if text is None:
            kept = self._scratch_reports.get(index)
            text = (self._from_file(index, ("report",)) if kept is None else kept)["report"].tobytes()
        try:
            report: dict[str, Any] = json.loads(text)
        except ValueError as error:
            raise HistoryError(f"{frame_file(index)}: its report is not valid JSON ({error})") from error
        if index in self._frames and index not in self._scratch_reports:
            self._texts[index] = text
        return report

    @property
    def first_report(self) -> dict[str, Any]:
        """The report of the first frame; empty where there is none that can be read."""
        with suppress(HistoryError):
            return self.report(next(iter(self._times))) if self._times else {}
        return {}

    @property
    def background(self) -> tuple[float, float, float]:
        """RGB in 0…1 behind everything, which frame 0 has found; black where its report has none.

        Raises:
            HistoryError: its file is damaged, and the copy as well.
        """
        if self._background is None and self._times:
            given = self.report(next(iter(self._times))).get("background")
            if given is None:  # its report was lost
                return 0.0, 0.0, 0.0
            red, green, blue = given
            self._background = (red, green, blue)
        return self._background or (0.0, 0.0, 0.0)

    def effects(self, index: int) -> dict[str, Arrays]:
        """What effects left of a committed frame for a cold start, by effect; nothing where it cannot be read."""
        return unpack_effects(self._left(index))

    def _left(self, index: int) -> NDArray[np.uint8] | None:
        """The same, packed; None: nothing."""
        self._require(index)
        left = self._packed.get(index)
        if left is None and self._files is not None:
            with suppress(FileNotFoundError, UnreadableFrameError):  # the state may be whole all the same
                left = self._files.read(index, (), (EFFECTS,)).get(EFFECTS)
        return left

    def _events(self) -> Int:
        """[E, 4] the log of the newest frame that can be read."""
        while (newest := self._newest()) >= 0:
            known, log = self._log
            if known > newest or (known >= 0 and self._files is None):  # frames were taken back since
                log = log[log[:, 0] <= newest]
            elif known < newest:
                try:
                    log = self._from_file(newest, (), (EVENTS,)).get(EVENTS, NO_EVENTS)
                except UnreadableFrameError:
                    continue  # it is forgotten, and the one before has all but its own
            self._log = (newest, log)
            return log
        return NO_EVENTS

    def log_at(self, index: int) -> Int:
        """The log as it was after a frame."""
        log = self._events()
        return log[log[:, 0] <= index] if len(log) else log

    def _fixed_after(self, births: list[tuple[int, int, int]]) -> Arrays:
        """``FIXED`` of all Gaussians after so many births."""
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
        """All that is kept of a birth: frame, first id, last id."""
        index, first, last = birth
        known = self._births.get(index)
        if self._files is not None and (known is None or known["ids"][0] != first):
            try:
                self._births[index] = known = self._files.read_born(index)
            except UnreadableFrameError as error:
                raise DamagedFrameError(str(error)) from error
        if known is None or (known["ids"][0], known["ids"][-1]) != (first, last):
            raise DamagedFrameError(f"the Gaussians {first} to {last}, born in frame {index}, are not those on disk")
        return known

    def _require(self, index: int) -> None:
        if index in self._times:
            return
        if index in self.damaged:
            raise DamagedFrameError(f"frame {index} cannot be read: {self.damaged[index]}")
        held = f"{next(iter(self._times))} to {self._newest()}" if self._times else "none yet"
        raise UnreadableFrameError(f"frame {index} is not in the history; committed frames: {held}")

    def _newest(self) -> int:
        """Index of the last frame, -1 without one; ``indices`` copies all of them."""
        return next(reversed(self._times), -1)

    def _from_file(self, index: int, names: Sequence[str], optional: Sequence[str] = ()) -> Arrays:
        assert self._files is not None
        try:
            return self._files.read(index, names, optional)
        except FileNotFoundError:
            self._forget(index)  # deleted, by the process that appends or by another
            self._files.faults[self._files.path(index).name] = f"{self._files.path(index).name} is gone"
            self._require(index)
            raise
        except UnreadableFrameError as error:
            stamp = self._stamps.get(index)
            self._forget(index)
            self.damaged[index] = str(error)
            if stamp is not None:  # until another file is there
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
            newest = self._newest()
            for old in [i for i in self._frames if i != newest][: max(0, len(self._frames) - FRAMES_KEPT)]:
                del self._frames[old]
                self._texts.pop(old, None)
                self._packed.pop(old, None)
