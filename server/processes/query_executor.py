"""Execution of queued queries in a reader process.

If the process exits unexpectedly, it is restarted with exponential backoff.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

from server import counters
from server.messages import DamageFound, SceneSpec
from server.problems import Problem, count_noun
from server.processes.placement import Entry, Placement, ProcessExit, ProcessHandle
from server.processes.queries import Answer, NumberedQuery, Query, QueryRefused

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 30.0
"""Initial and maximum delay in seconds before a process that exited unexpectedly is restarted.

The delay doubles with each exit until a query is answered.
"""
MOST_WAITING = 64
"""Maximum number of queued queries; further ones are refused with 503.

This corresponds to one or two seconds of rendering. A longer queue would only add latency.
"""
ANSWER_SECONDS = 120.0
"""Timeout in seconds, after which a query fails with 503; the longest accepted query takes about half of that."""

OnDamage = Callable[[Mapping[str, str]], None]
"""Callback that receives a mapping from the name of each unreadable file in the states folder to the reason."""

log = logging.getLogger("scas4d.server")


@dataclass(eq=False)
class _WaitingQuery:
    """Queued query with the future of its answer; `lost` is set if a reader's machine was lost while answering it."""

    number: int
    query: Query
    answer: asyncio.Future[Answer | QueryRefused]
    lost: bool = False

    def end(self, answer: Answer | QueryRefused) -> None:
        if not self.answer.done():
            self.answer.set_result(answer)


class QueryExecutor:
    """Reader process with a queue of queries, handled one at a time; cancelled queries are never started.

    Args:
        entry: process entry point.
        spec: scene specification.
        placement: placement used to start the process.
        grace: time in seconds that the process may spend on a cancelled query before it is stopped.
        damaged: callback for damaged files; receives the reason for each, keyed by file name.

    Attributes:
        process: handle of the process; None before the first query and while the process is not running.
        stale: frames that were committed, deleted or rolled back since the last query; None if any frame may have
            changed.
    """

    def __init__(
        self,
        entry: Entry,
        spec: SceneSpec,
        placement: Placement,
        *,
        grace: float,
        damaged: OnDamage,
    ) -> None:
        self._entry = entry
        self._spec = spec
        self._placement = placement
        self._grace = grace
        self._damaged = damaged
        self._waiting: deque[_WaitingQuery] = deque()
        self._at_work: _WaitingQuery | None = None
        self.process: ProcessHandle | None = None
        self._life: object = None
        self._ending: set[asyncio.Task[None]] = set()
        self._failures = 0
        self._pause: asyncio.TimerHandle | None = None
        self._asked = 0
        self.stale: set[int] | None = set()
        self._closed = False

    @property
    def busy(self) -> bool:
        """Whether a query is queued or being answered, or an abandoned process is stopping."""
        return bool(self._waiting or self._at_work or self._ending)

    def start(self) -> None:
        """Starts the process now instead of at the first query."""
        if self.process is None and self._pause is None and not self._closed:
            self._start()

    async def ask(self, query: Query) -> Answer | QueryRefused:
        """Queues a query and returns its answer.

        Raises:
            Problem: 503 if the queue is full or the answer takes more than `ANSWER_SECONDS`.
        """
        if len(self._waiting) >= MOST_WAITING:
            raise Problem(
                503,
                f"this scene already has {count_noun(len(self._waiting), 'waiting request')}",
                field="id",
                value=self._spec.folder.name,
                remedy="send fewer queries, or subscribe (WS …/stream), which sends only the newest answer",
                headers={"Retry-After": "1"},
            )
        if self._closed:
            return QueryRefused(0, "the scene was closed", status=503)
        self._asked += 1
        turn = _WaitingQuery(self._asked, query, asyncio.get_running_loop().create_future())
        self._waiting.append(turn)
        self._next()
        try:
            return await asyncio.wait_for(turn.answer, ANSWER_SECONDS)
        except TimeoutError:
            raise Problem(
                503,
                f"no answer within {ANSWER_SECONDS:g} s",
                field="id",
                value=self._spec.folder.name,
                remedy="request less data at once, or try again later",
                headers={"Retry-After": "5"},
            ) from None
        finally:
            if turn in self._waiting:
                self._waiting.remove(turn)
            if turn is self._at_work:  # the caller was cancelled or timed out
                asyncio.get_running_loop().call_later(self._grace, self._give_up, turn)

    async def stop(self, seconds: float) -> None:
        """Stops the process within `seconds`, or immediately if it is busy, and refuses queued and later queries."""
        self._closed = True
        if self._pause is not None:
            self._pause.cancel()
        turns = [*self._waiting, *([self._at_work] if self._at_work else [])]
        process, busy = self.process, self._at_work is not None
        self.process = self._at_work = None
        if process is not None:
            await process.stop(0 if busy else seconds)
        await asyncio.gather(*self._ending)
        for turn in turns:
            turn.end(QueryRefused(turn.number, "the scene was closed", status=503))

    def _start(self) -> None:
        self._life = life = object()
        ended = partial(self._process_ended, life)
        self.process = self._placement.start(self._entry, self._spec, self._on_answer, ended)

    def _next(self) -> None:
        """Sends the next query to the process if it is idle."""
        if self._at_work is not None or self._pause is not None or self._closed or not self._waiting:
            return
        if self.process is None:
            self._start()
        assert self.process is not None
        self._at_work = self._waiting.popleft()
        stale, self.stale = None if self.stale is None else frozenset(self.stale), set()
        self.process.send(NumberedQuery(self._at_work.number, self._at_work.query, stale))

    def _on_answer(self, message: Answer | QueryRefused | DamageFound) -> None:
        if isinstance(message, DamageFound):
            self._damaged(message.files)
            return
        turn = self._at_work
        if turn is None or turn.number != message.number:  # answer of an abandoned process
            return
        self._failures = 0
        self._at_work = None
        turn.end(message)
        self._next()

    def _give_up(self, turn: _WaitingQuery) -> None:
        """Stops the process if it is still working on a cancelled query."""
        if self._at_work is not turn or self.process is None:
            return
        log.warning(
            "scene %s: a %s query was cancelled; restarting the reader", self._spec.folder.name, turn.query.kind
        )
        task = asyncio.ensure_future(self.process.stop(0))
        self._ending.add(task)
        task.add_done_callback(self._ending.discard)
        self.process = self._at_work = self._life = None
        self._next()

    def _process_ended(self, life: object, reason: ProcessExit) -> None:
        if life is not self._life or self._closed:
            return
        counters.RESTARTS.labels("reader").inc()
        turn, self.process, self._at_work = self._at_work, None, None
        pause = min(LONGEST_PAUSE_S, FIRST_PAUSE_S * 2**self._failures)
        self._failures += 1
        log.error("scene %s: a reader exited (%s); restarting it in %g s", self._spec.folder.name, reason, pause)
        if turn is not None and not turn.answer.done():
            if reason.lost and not turn.lost:  # not caused by the query, so the next reader answers it
                turn.lost = True
                self._waiting.appendleft(turn)
            else:
                fault = f"the reader exited while processing this query ({reason})"
                turn.end(QueryRefused(turn.number, fault, status=503 if reason.lost else 500))
        self._pause = asyncio.get_running_loop().call_later(pause, self._restart)

    def _restart(self) -> None:
        self._pause = None
        self._next()
