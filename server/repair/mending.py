"""What was found damaged while a scene runs: said, written or made again by its worker, or named as lost.

Files of the states' folder come here by name, from whoever could not read one: a reader, a replay, a scrub. The worker
looks at each between two frames and writes again what it has in memory or a copy of. A state that it has not is made
again from its pictures when no frame waits; until then views of it are asked to come back, and where that is not
possible it is named.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol

from client.wire import FrameState
from scas4d_core.storage.frame_files import checkpoint_of, frame_file, frame_of
from server.processes.messages import FrameReady, Mend, Mended, MendOutcome, Remake
from server.repair.damage import DamageKind, DamageLog
from server.storage.events import JournalEvent, StatesDeleted
from server.storage.ledger import Ledger

AGAIN_S = 5.0
"""What the disk had no room for is tried again after so long."""
OF_REMAKE = frozenset({MendOutcome.REMADE, MendOutcome.LOST, MendOutcome.LATER, MendOutcome.NO_ROOM})
"""Answers that end the making of a state; others may be of the same file, asked about before."""
DEATHS = 2
"""A state at whose making the worker dies so often is given up."""

log = logging.getLogger("scas4d.server")


class Hooks(Protocol):
    """What mending needs of its scene."""

    def to_worker(self, message: Any) -> bool:
        """Posts a message; False where there is no worker that takes any."""

    def states_changed(self, frames: tuple[int, ...]) -> None:
        """Files of states were written or lost: readers look again, and a frame may begin."""

    def write_event(self, event: JournalEvent) -> None:
        """Journals an event that was applied, in the background."""


class Mending:
    """Of one scene. On the event loop.

    Args:
        ledger: of the scene. damage: where it is said. hooks: of the scene.
        remake: frames whose states were found damaged at the start, with the reason.

    Attributes:
        at_work: the frame whose state the worker is making again, or None.
    """

    def __init__(self, ledger: Ledger, damage: DamageLog, hooks: Hooks, remake: Mapping[int, str]) -> None:
        self._ledger = ledger
        self._damage = damage
        self._hooks = hooks
        self._asked: dict[str, str] = {}
        self._waiting: dict[int, str] = {}
        self._deaths: dict[int, int] = {}
        self._timers: dict[str, asyncio.TimerHandle] = {}
        self._full_until = 0.0
        self.at_work: int | None = None
        for index, reason in remake.items():
            self._decide(index, reason)

    @property
    def frames(self) -> frozenset[int]:
        """Whose states are to be made again: their pictures are needed."""
        return frozenset(self._waiting)

    @property
    def trouble(self) -> str | None:
        """What is wrong now and may be mended; None: nothing."""
        if self._waiting:
            return f"the state of frame {min(self._waiting)} was damaged on disk and is being made again"
        if self._asked:
            return f"{next(iter(self._asked))} was found damaged on disk and is being looked at"
        return None

    def noticed(self, files: Mapping[str, str]) -> None:
        """Files of the states' folder could not be read, by name with the reason."""
        new = {}
        for name, reason in files.items():
            index = frame_of(name)
            entry = None if index is None else self._ledger.frames.get(index)
            gone = index is not None and (entry is None or entry.deleted or entry.state != FrameState.COMMITTED)
            if not gone and name not in self._asked and index not in self._waiting:
                new[name] = reason
        self._asked |= new
        self._ask(new)

    def taken_up(self, damaged: Mapping[int, str]) -> None:
        """There is a worker: it is asked what the one before did not answer, and of states that it found damaged."""
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
                if (numbers := entry.numbers) is not None:
                    known[index] = dict(numbers)
        if message := tuple(names):
            self._hooks.to_worker(Mend(message, times, known))

    def begin(self) -> bool:
        """Gives the worker the next state to make again, if one waits; called when it has nothing else to do."""
        if self._waiting and asyncio.get_running_loop().time() < self._full_until:
            return False
        for index in sorted(self._waiting):
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
            if self._hooks.to_worker(Remake(frame, base)):
                self.at_work = index
                return True
            return False
        return False

    def mended(self, message: Mended) -> None:
        """What the worker says of a file or of a state."""
        index = frame_of(message.name)
        reason = self._asked.pop(message.name, message.reason)
        if index is not None and index == self.at_work and message.outcome in OF_REMAKE:
            self.at_work = None
        match message.outcome:
            case MendOutcome.WHOLE:
                log.warning("%s could not be read once (%s), and is whole", message.name, reason)
            case MendOutcome.WRITTEN:
                self._say(message.name, f"{message.reason}; it was written again, and nothing is lost")
            case MendOutcome.REPORT_LOST:
                self._say(
                    message.name, f"{message.reason}; its state is whole and was written again, its report is lost"
                )
            case MendOutcome.DAMAGED if index is not None:
                self._decide(index, message.reason)
            case MendOutcome.DAMAGED if checkpoint_of(message.name) is not None:
                self._say(message.name, f"{message.reason}; it is needed by nothing but a second damage", lasting=True)
            case MendOutcome.DAMAGED:
                self._say(message.name, f"{message.reason}; it cannot be made again", lasting=True)
            case MendOutcome.REMADE:
                assert index is not None
                reason = self._waiting.pop(index, reason)
                self._ledger.frames.set_unreadable(index, False)
                self._ledger.frames.amend(index, message.report)
                self._say(
                    message.name,
                    f"frame {index}: {reason}; its state was made again from its pictures, not with the same bits",
                )
            case MendOutcome.LOST:
                assert index is not None
                self._lost(index, message.reason)
            case MendOutcome.NO_ROOM:
                if index is None or index not in self._waiting:
                    self._asked[message.name] = reason
                    self._later(message.name, lambda: self._ask({message.name} & self._asked.keys()))
                else:
                    self._full_until = asyncio.get_running_loop().time() + AGAIN_S
                    self._later(message.name, lambda: self._hooks.states_changed(()))
            case MendOutcome.GONE | MendOutcome.LATER:
                pass
        self._hooks.states_changed(() if index is None else (index,))

    def _later(self, name: str, call: Callable[[], None]) -> None:
        """Tries again after a while; one such timer a file, however often it is asked about."""
        if (timer := self._timers.pop(name, None)) is not None:
            timer.cancel()
        self._timers[name] = asyncio.get_running_loop().call_later(AGAIN_S, call)

    def retired(self, frames: Iterable[int]) -> None:
        """The scene's rule has deleted these states: there is nothing to mend of them any more."""
        for index in frames:
            self._asked.pop(frame_file(index), None)
            if self._waiting.pop(index, None) is not None:
                self._ledger.frames.set_unreadable(index, False)

    def stop(self) -> None:
        """Nothing is tried again."""
        for timer in self._timers.values():
            timer.cancel()

    def _decide(self, index: int, reason: str) -> None:
        """A state is damaged, and nothing but its pictures can bring it back."""
        entry = self._ledger.frames[index]
        degraded = None if entry.numbers is None else entry.numbers.get("degraded")
        self._waiting[index] = reason
        self._ledger.frames.set_unreadable(index, True)
        if not entry.files:
            self._lost(index, "its pictures are no longer held")
        elif degraded is not None:
            self._lost(index, f"it was {degraded}")
        elif self._base(index) is None:
            self._lost(index, "the state before it cannot be read")

    def _base(self, index: int) -> int | None:
        """The committed frame that one was updated from; None where its state is gone."""
        for before in range(index - 1, -1, -1):
            entry = self._ledger.frames[before]
            if entry.state == FrameState.COMMITTED:
                return None if entry.deleted else before
        return None

    def _lost(self, index: int, why: str) -> None:
        reason = self._waiting.pop(index, "its state is damaged")
        said = f"the state of frame {index} was damaged on disk and cannot be made again: {why}"
        self._ledger.frames.set_unreadable(index, False)
        event = StatesDeleted(frames=(index,), reason=said)
        self._ledger.apply(event)
        self._damage.say(DamageKind.STATE, f"{said} ({reason})")
        self._hooks.write_event(event)

    def _say(self, name: str, sentence: str, *, lasting: bool = False) -> None:
        kind = DamageKind.FIXED
        if frame_of(name) is not None:
            kind = DamageKind.STATE
        elif checkpoint_of(name) is not None:
            kind = DamageKind.CHECKPOINT
        self._damage.say(kind, sentence, lasting=lasting)
        log.warning("%s", sentence)
