"""Queue of repairs for damage found in a running scene; the worker rewrites or recomputes the affected states.

Readers, replays and scrubs report damaged files in the states folder. Between frames, the worker checks each file and
rewrites it from memory or from a copy if possible. Other states are recomputed from their images when no frame is
waiting, and queries for them return 503 until then. If recomputation is impossible, the state is reported as lost.
"""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from enum import StrEnum
from typing import Any

from client.wire import FrameState
from scas4d_core.errors import without_paths
from scas4d_core.storage.frame_files import checkpoint_of, frame_file, frame_of
from server import counters
from server.background import Background
from server.keep_up import with_time_limit
from server.messages import FrameReady, RecomputeState, RepairFiles, RepairOutcome, RepairResult
from server.storage.events import StatesDeleted
from server.storage.ledger import SceneLog

SENTENCES_KEPT = 100
"""Maximum number of damage messages that are kept; the oldest messages are dropped."""
RETRY_S = 5.0
"""Delay in seconds before a repair that failed because of a full disk is retried."""
RECOMPUTE_OUTCOMES = frozenset(
    {RepairOutcome.RECOMPUTED, RepairOutcome.LOST, RepairOutcome.LATER, RepairOutcome.NO_ROOM}
)
"""Outcomes that end the recomputation of a state; other outcomes may belong to an earlier request for the file."""
MAX_DEATHS = 2
"""Number of worker crashes during the recomputation of a state after which the state is declared lost."""

log = logging.getLogger("scas4d.server")


class DamageKind(StrEnum):
    """Kind of a damaged file."""

    STATE = "state"
    CHECKPOINT = "checkpoint"
    FIXED = "fixed"
    JOURNAL = "journal"
    FRAME = "frame"
    DEFINITION = "definition"
    POINTS = "points"


class DamageLog:
    """Log of the newest damage messages of one scene, limited so that a failing disk does not exhaust memory.

    Repeated messages are counted, or ignored if they concern the same lasting damage.

    Args:
        sentences: messages from the scene's recovery.
    """

    def __init__(self, sentences: Iterable[str] = ()) -> None:
        self._counts: OrderedDict[str, int] = OrderedDict()
        self._more = 0
        for sentence in sentences:
            self._keep(without_paths(sentence))

    def add(self, kind: DamageKind, sentence: str, *, lasting: bool = False) -> None:
        """Adds a message; `lasting` marks damage that cannot be repaired, so every check finds it again."""
        sentence = without_paths(sentence)
        if lasting and sentence in self._counts:
            return
        counters.DAMAGE.labels(kind.value).inc()
        self._keep(sentence)

    def _keep(self, sentence: str) -> None:
        self._counts[sentence] = self._counts.pop(sentence, 0) + 1
        while len(self._counts) > SENTENCES_KEPT:
            self._counts.popitem(last=False)
            self._more += 1

    @property
    def sentences(self) -> list[str]:
        """Newest messages in order, preceded by the number of dropped messages, if any."""
        before = [f"{self._more} earlier messages are only in the service log"] if self._more else []
        return [*before, *(text if count == 1 else f"{text} ({count} times)" for text, count in self._counts.items())]


class RepairQueue:
    """Repair queue of one scene. All methods run on the event loop.

    Args:
        log: the scene's journal, ledger and frame log.
        damage: the scene's damage messages.
        background: the scene's background tasks.
        to_worker: function that sends a message to the worker; returns False if no worker can receive it.
        recompute: maps each frame whose state was found damaged during recovery to the reason.

    Attributes:
        at_work: frame whose state the worker is recomputing, or None.
        waiting: maps each frame whose state must be recomputed to the reason. The images of these frames must be kept.
    """

    def __init__(
        self,
        log: SceneLog,
        damage: DamageLog,
        background: Background,
        *,
        to_worker: Callable[[Any], bool],
        recompute: Mapping[int, str],
    ) -> None:
        self._log = log
        self._ledger = log.ledger
        self._damage = damage
        self._background = background
        self._to_worker = to_worker
        self._requested: dict[str, str] = {}
        self.waiting: dict[int, str] = {}
        self._deaths: dict[int, int] = {}
        self._timers: dict[str, asyncio.TimerHandle] = {}
        self._full_until = 0.0
        self._stopped = False
        self.at_work: int | None = None
        for index, reason in recompute.items():
            self._decide(index, reason)

    @property
    def current_repair(self) -> str | None:
        """Message about damage that is being repaired, or None."""
        if self.waiting:
            return f"the state of frame {min(self.waiting)} was damaged on disk and is being recomputed"
        if self._requested:
            return f"{next(iter(self._requested))} was found damaged on disk and is being checked"
        return None

    def report_damage(self, files: Mapping[str, str]) -> None:
        """Asks the worker to check unreadable files in the states folder.

        Args:
            files: description of the fault of each file, keyed by file name.
        """
        new = {}
        for name, reason in files.items():
            index = frame_of(name)
            entry = None if index is None else self._ledger.frames.get(index)
            gone = index is not None and (entry is None or entry.deleted or entry.state != FrameState.COMMITTED)
            if not gone and name not in self._requested and index not in self.waiting:
                new[name] = reason
        self._requested |= new
        self._ask(new)

    def resume(self, damaged: Mapping[int, str]) -> None:
        """Resends unanswered requests to a new worker, and adds the damaged states that this worker found."""
        if self.at_work is not None:
            self._deaths[self.at_work] = self._deaths.get(self.at_work, 0) + 1
            if self._deaths[self.at_work] >= MAX_DEATHS:
                self._declare_unrecoverable(self.at_work, "the worker crashed each time it recomputed the state")
            self.at_work = None
        self._ask(self._requested)
        self.report_damage({frame_file(index): reason for index, reason in damaged.items()})

    def _ask(self, names: Iterable[str]) -> None:
        known: dict[int, dict[str, Any]] = {}
        times: dict[int, float] = {}
        for name in names:
            if (index := frame_of(name)) is not None and (entry := self._ledger.frames.get(index)) is not None:
                if entry.time is not None:
                    times[index] = entry.time
                if (record := entry.record) is not None:
                    known[index] = dict(record)
        if message := tuple(names):
            self._to_worker(RepairFiles(message, times, known))

    def begin(self) -> float:
        """Asks the worker, if it is idle, to recompute the next waiting state.

        Returns:
            The delay in seconds before the next call of this method if the disk was full, otherwise 0.
        """
        if (left := self._full_until - asyncio.get_running_loop().time()) > 0:
            return left
        for index in sorted(self.waiting):
            base = self._base(index)
            if base is None:
                self._declare_unrecoverable(index, "the previous state cannot be read")
                continue
            entry = self._ledger.frames[index]
            receipt = entry.receipt
            if receipt is None or not entry.files:
                self._declare_unrecoverable(index, "its images are no longer stored")
                continue
            budget = with_time_limit(self._ledger.budget_of(index), waiting=0)
            frame = FrameReady(index, receipt.time, entry.files, receipt.identity, budget)
            if self._to_worker(RecomputeState(frame, base)):
                self.at_work = index
            break
        return 0.0

    def handle_result(self, message: RepairResult) -> tuple[int, ...]:
        """Handles a repair result of the worker, and returns the frames that readers must reload."""
        index = frame_of(message.name)
        reason = self._requested.pop(message.name, message.reason)
        if index is not None and index == self.at_work and message.outcome in RECOMPUTE_OUTCOMES:
            self.at_work = None
        match message.outcome:
            case RepairOutcome.WHOLE:
                log.warning("%s could not be read (%s), but is intact", message.name, reason)
            case RepairOutcome.WRITTEN:
                self._log_damage(message.name, f"{message.reason}; it was rewritten, and nothing was lost")
            case RepairOutcome.REPORT_LOST:
                self._log_damage(
                    message.name, f"{message.reason}; the state is intact and was rewritten, but the report is lost"
                )
            case RepairOutcome.DAMAGED if index is not None:
                self._decide(index, message.reason)
            case RepairOutcome.DAMAGED if checkpoint_of(message.name) is not None:
                self._log_damage(
                    message.name, f"{message.reason}; it is needed only if more files are damaged", lasting=True
                )
            case RepairOutcome.DAMAGED:
                self._log_damage(message.name, f"{message.reason}; it cannot be recomputed", lasting=True)
            case RepairOutcome.RECOMPUTED:
                assert index is not None
                reason = self.waiting.pop(index, reason)
                self._ledger.frames.set_unreadable(index, False)
                self._ledger.frames.replace_record(index, message.report)
                self._log_damage(
                    message.name,
                    f"frame {index}: {reason}; the state was recomputed from its images and is not bit-identical",
                )
            case RepairOutcome.LOST:
                assert index is not None
                self._declare_unrecoverable(index, message.reason)
            case RepairOutcome.NO_ROOM:
                if index is None or index not in self.waiting:
                    self._requested[message.name] = reason
                    self._ask_later(message.name)
                else:
                    self._full_until = asyncio.get_running_loop().time() + RETRY_S
            case RepairOutcome.GONE | RepairOutcome.LATER:
                pass
        return () if index is None else (index,)

    def _ask_later(self, name: str) -> None:
        """Schedules another check of a file, with at most one timer per file."""
        if self._stopped:
            return
        if (timer := self._timers.pop(name, None)) is not None:
            timer.cancel()
        self._timers[name] = asyncio.get_running_loop().call_later(RETRY_S, self._ask_again, name)

    def _ask_again(self, name: str) -> None:
        if name in self._requested:
            self._ask({name})

    def forget_states(self, frames: Iterable[int]) -> None:
        """Drops repairs of states that retention has deleted."""
        for index in frames:
            self._requested.pop(frame_file(index), None)
            if self.waiting.pop(index, None) is not None:
                self._ledger.frames.set_unreadable(index, False)

    def stop(self) -> None:
        """Cancels all timers and prevents new ones."""
        self._stopped = True
        for timer in self._timers.values():
            timer.cancel()

    def _decide(self, index: int, reason: str) -> None:
        """Queues a damaged state for recomputation, or declares the state lost."""
        entry = self._ledger.frames[index]
        degraded = None if entry.record is None else entry.record.get("degraded")
        self.waiting[index] = reason
        self._ledger.frames.set_unreadable(index, True)
        if not entry.files:
            self._declare_unrecoverable(index, "its images are no longer stored")
        elif degraded is not None:
            self._declare_unrecoverable(index, f"the frame was degraded: {degraded}")
        elif self._base(index) is None:
            self._declare_unrecoverable(index, "the previous state cannot be read")

    def _base(self, index: int) -> int | None:
        """Returns the last committed frame before a frame, whose state the frame is based on.

        Returns None if there is no such frame or its state was deleted.
        """
        for before in range(index - 1, -1, -1):
            entry = self._ledger.frames[before]
            if entry.state == FrameState.COMMITTED:
                return None if entry.deleted else before
        return None

    def _declare_unrecoverable(self, index: int, why: str) -> None:
        """Declares the state of a frame lost because it cannot be recomputed, and records the damage."""
        reason = self.waiting.pop(index, "its state is damaged")
        sentence = f"the state of frame {index} was damaged on disk and cannot be recomputed: {why}"
        self._ledger.frames.set_unreadable(index, False)
        event = StatesDeleted(frames=(index,), reason=sentence)
        self._ledger.apply(event)
        self._damage.add(DamageKind.STATE, f"{sentence} ({reason})")
        self._background.run(self._log.write(event))

    def _log_damage(self, name: str, sentence: str, *, lasting: bool = False) -> None:
        kind = DamageKind.FIXED
        if frame_of(name) is not None:
            kind = DamageKind.STATE
        elif checkpoint_of(name) is not None:
            kind = DamageKind.CHECKPOINT
        self._damage.add(kind, sentence, lasting=lasting)
        log.warning("%s", sentence)
