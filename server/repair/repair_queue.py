"""Decides about damage that is found while a scene runs: reports it, and has the worker write or make states again.

Damaged files of the states' folder are noticed by a reader, a replay or a scrub. Between two frames the worker checks
each and writes again what it has in memory or as a copy. Other states are made again from their pictures when no frame
waits; until then queries for them get 503, and where that is not possible the state is reported as lost.
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
from server.messages import FrameReady, RecomputeState, RepairFiles, RepairOutcome, RepairResult
from server.storage.events import StatesDeleted
from server.storage.ledger import SceneLog

SENTENCES_KEPT = 100
"""Sentences about damage that are kept: the newest."""
AGAIN_S = 5.0
"""RepairQueue for which the disk had no room is tried again after so long."""
OF_RECOMPUTE = frozenset({RepairOutcome.RECOMPUTED, RepairOutcome.LOST, RepairOutcome.LATER, RepairOutcome.NO_ROOM})
"""Outcomes that end the remaking of a state; others may be of the same file, asked about before."""
DEATHS = 2
"""A state is given up after so many deaths of the worker while it made it again."""

log = logging.getLogger("scas4d.server")


class DamageKind(StrEnum):
    """Kinds of damaged file."""

    STATE = "state"
    CHECKPOINT = "checkpoint"
    FIXED = "fixed"
    JOURNAL = "journal"
    FRAME = "frame"
    DEFINITION = "definition"
    POINTS = "points"


class DamageLog:
    """Sentences about damage found in one scene; the newest, so that a dying disk does not fill the memory.

    A sentence that comes again is counted, or left out where it is of the same damage.

    Args:
        sentences: from the start of the service.
    """

    def __init__(self, sentences: Iterable[str] = ()) -> None:
        self._counts: OrderedDict[str, int] = OrderedDict()
        self._more = 0
        for sentence in sentences:
            self._keep(without_paths(sentence))

    def say(self, kind: DamageKind, sentence: str, *, lasting: bool = False) -> None:
        """Adds a sentence. `lasting`: nothing mends the damage, and each check finds it again."""
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
        """The newest sentences, in order; the first one says how many came before them."""
        before = [f"{self._more} more before these; the service's log has them"] if self._more else []
        return [*before, *(text if count == 1 else f"{text} ({count} times)" for text, count in self._counts.items())]


class RepairQueue:
    """Mends the damage of one scene. On the event loop.

    Args:
        log, damage, background: of the scene.
        to_worker: posts a message; returns False where no worker can receive one.
        recompute: frames whose states were found damaged at the start, with the reason.

    Attributes:
        at_work: the frame whose state the worker is making again, or None.
        waiting: frames whose states are to be made again, with the reason: their pictures are needed.
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
        self._asked: dict[str, str] = {}
        self.waiting: dict[int, str] = {}
        self._deaths: dict[int, int] = {}
        self._timers: dict[str, asyncio.TimerHandle] = {}
        self._full_until = 0.0
        self._stopped = False
        self.at_work: int | None = None
        for index, reason in recompute.items():
            self._decide(index, reason)

    @property
    def trouble(self) -> str | None:
        """A sentence about damage that is being mended, or None."""
        if self.waiting:
            return f"the state of frame {min(self.waiting)} was damaged on disk and is being made again"
        if self._asked:
            return f"{next(iter(self._asked))} was found damaged on disk and is being checked"
        return None

    def noticed(self, files: Mapping[str, str]) -> None:
        """Has the worker check files of the states' folder that could not be read, by name with the reason."""
        new = {}
        for name, reason in files.items():
            index = frame_of(name)
            entry = None if index is None else self._ledger.frames.get(index)
            gone = index is not None and (entry is None or entry.deleted or entry.state != FrameState.COMMITTED)
            if not gone and name not in self._asked and index not in self.waiting:
                new[name] = reason
        self._asked |= new
        self._ask(new)

    def taken_up(self, damaged: Mapping[int, str]) -> None:
        """Asks a new worker about all that the one before did not answer, and about states that it found damaged."""
        if self.at_work is not None:
            self._deaths[self.at_work] = self._deaths.get(self.at_work, 0) + 1
            if self._deaths[self.at_work] >= DEATHS:
                self._lost(self.at_work, "the worker died each time that it was made again")
            self.at_work = None
        self._ask(self._asked)
        self.noticed({frame_file(index): reason for index, reason in damaged.items()})

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
        """Gives an idle worker the next state to make again, if one waits.

        Returns:
            The seconds until this is to be called again, where the disk was full; else 0.
        """
        if (left := self._full_until - asyncio.get_running_loop().time()) > 0:
            return left
        for index in sorted(self.waiting):
            base = self._base(index)
            if base is None:
                self._lost(index, "the state before it cannot be read")
                continue
            entry = self._ledger.frames[index]
            receipt = entry.receipt
            if receipt is None or not entry.files:
                self._lost(index, "its pictures are no longer held")
                continue
            frame = FrameReady(index, receipt.time, entry.files, receipt.identity, self._ledger.budget_of(index))
            if self._to_worker(RecomputeState(frame, base)):
                self.at_work = index
            break
        return 0.0

    def handle_result(self, message: RepairResult) -> tuple[int, ...]:
        """Acts on the worker's answer about a file or a state; returns the frames that readers have to read again."""
        index = frame_of(message.name)
        reason = self._asked.pop(message.name, message.reason)
        if index is not None and index == self.at_work and message.outcome in OF_RECOMPUTE:
            self.at_work = None
        match message.outcome:
            case RepairOutcome.WHOLE:
                log.warning("%s could not be read once (%s), and is whole", message.name, reason)
            case RepairOutcome.WRITTEN:
                self._say(message.name, f"{message.reason}; it was written again, and nothing is lost")
            case RepairOutcome.REPORT_LOST:
                self._say(
                    message.name, f"{message.reason}; its state is whole and was written again, its report is lost"
                )
            case RepairOutcome.DAMAGED if index is not None:
                self._decide(index, message.reason)
            case RepairOutcome.DAMAGED if checkpoint_of(message.name) is not None:
                self._say(message.name, f"{message.reason}; it is needed by nothing but a second damage", lasting=True)
            case RepairOutcome.DAMAGED:
                self._say(message.name, f"{message.reason}; it cannot be made again", lasting=True)
            case RepairOutcome.RECOMPUTED:
                assert index is not None
                reason = self.waiting.pop(index, reason)
                self._ledger.frames.set_unreadable(index, False)
                self._ledger.frames.amend(index, message.report)
                self._say(
                    message.name,
                    f"frame {index}: {reason}; its state was made again from its pictures, not with the same bits",
                )
            case RepairOutcome.LOST:
                assert index is not None
                self._lost(index, message.reason)
            case RepairOutcome.NO_ROOM:
                if index is None or index not in self.waiting:
                    self._asked[message.name] = reason
                    self._ask_later(message.name)
                else:
                    self._full_until = asyncio.get_running_loop().time() + AGAIN_S
            case RepairOutcome.GONE | RepairOutcome.LATER:
                pass
        return () if index is None else (index,)

    def _ask_later(self, name: str) -> None:
        """Asks about a file again after a while; there is one timer a file, however often it is asked about."""
        if self._stopped:
            return
        if (timer := self._timers.pop(name, None)) is not None:
            timer.cancel()
        self._timers[name] = asyncio.get_running_loop().call_later(AGAIN_S, self._ask_again, name)

    def _ask_again(self, name: str) -> None:
        if name in self._asked:
            self._ask({name})

    def retired(self, frames: Iterable[int]) -> None:
        """Forgets states that retention has deleted."""
        for index in frames:
            self._asked.pop(frame_file(index), None)
            if self.waiting.pop(index, None) is not None:
                self._ledger.frames.set_unreadable(index, False)

    def stop(self) -> None:
        """Cancels the timers, and starts no other."""
        self._stopped = True
        for timer in self._timers.values():
            timer.cancel()

    def _decide(self, index: int, reason: str) -> None:
        """Queues a damaged state to be made again from its pictures, or gives it up."""
        entry = self._ledger.frames[index]
        degraded = None if entry.record is None else entry.record.get("degraded")
        self.waiting[index] = reason
        self._ledger.frames.set_unreadable(index, True)
        if not entry.files:
            self._lost(index, "its pictures are no longer held")
        elif degraded is not None:
            self._lost(index, f"it was {degraded}")
        elif self._base(index) is None:
            self._lost(index, "the state before it cannot be read")

    def _base(self, index: int) -> int | None:
        """Returns the committed frame that a frame was updated from; None where its state is gone."""
        for before in range(index - 1, -1, -1):
            entry = self._ledger.frames[before]
            if entry.state == FrameState.COMMITTED:
                return None if entry.deleted else before
        return None

    def _lost(self, index: int, why: str) -> None:
        reason = self.waiting.pop(index, "its state is damaged")
        sentence = f"the state of frame {index} was damaged on disk and cannot be made again: {why}"
        self._ledger.frames.set_unreadable(index, False)
        event = StatesDeleted(frames=(index,), reason=sentence)
        self._ledger.apply(event)
        self._damage.say(DamageKind.STATE, f"{sentence} ({reason})")
        self._background.run(self._log.write(event))

    def _say(self, name: str, sentence: str, *, lasting: bool = False) -> None:
        kind = DamageKind.FIXED
        if frame_of(name) is not None:
            kind = DamageKind.STATE
        elif checkpoint_of(name) is not None:
            kind = DamageKind.CHECKPOINT
        self._damage.say(kind, sentence, lasting=lasting)
        log.warning("%s", sentence)
