"""Answers queries about the committed states of a scene: its two reader processes and the queues before them.

Views have a process of their own: a long track query, or a search for parts, never stands before them. The other
process starts with its first query, runs at a lower priority, and is ended when its query was cancelled: it holds
nothing that is not on disk. A process that ends by itself is started again, each time after a longer pause.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from server.health import metrics
from server.problems import SERVICE_FAULT, Problem, counted
from server.processes import renderer, track_answers
from server.processes.messages import (
    Answer,
    AskedQuery,
    Damaged,
    GaussiansQuery,
    LabelsQuery,
    Query,
    Refused,
    RenderQuery,
    SceneSpec,
    TracksQuery,
    asked,
)
from server.processes.placement import STOP_SECONDS, Entry, Placement, Process

GRACE_VIEWS_S, GRACE_BULK_S = 10.0, 1.0
"""A process may go on for so long with a cancelled query: a new process takes a second or two to start."""
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 30.0
"""Pause before a process that ended by itself is started again; it doubles with each end without an answer."""
MOST_WAITING = 64
"""Queries before a process; more get 503. Beyond a second or two of views, waiting only makes it worse."""
ANSWER_SECONDS = 120.0
"""A query that takes longer gets 503: the longest that is let in takes about half of it."""
MOST_STALE = 10_000
"""Frames that are noted one by one; for more, the states are listed anew."""
COUNTS_KEPT = 8
"""Numbers of parts whose labels are kept."""

NOT_COMMITTED = "ask for a frame that the scene's status counts as committed"
REMEDIES = {404: NOT_COMMITTED, 500: SERVICE_FAULT, 503: "ask again later"}
"""Remedies by the status of an answer, where the process says none."""

Noticed = Callable[[Mapping[str, str]], None]
"""Called with files of the states' folder that cannot be read, by name with the reason."""

log = logging.getLogger("scas4d.server")


@dataclass(eq=False)
class _WaitingQuery:
    """A query and the future of its answer."""

    number: int
    query: Query
    answer: asyncio.Future[Answer | Refused]

    def end(self, answer: Answer | Refused) -> None:
        if not self.answer.done():
            self.answer.set_result(answer)


class QueryQueue:
    """A reader process and the queue before it. The process has one query at a time; cancelled ones are never started.

    Args:
        entry: what runs in the process. eager: start it now, not with the first query.
        grace: seconds, see above. damaged: called with the files that the process found damaged.

    Attributes:
        process: or None, before the first query and while it rests.
    """

    def __init__(
        self,
        entry: Entry,
        spec: SceneSpec,
        placement: Placement,
        *,
        eager: bool,
        grace: float,
        damaged: Noticed,
    ) -> None:
        self._entry = entry
        self._spec = spec
        self._placement = placement
        self._grace = grace
        self._damaged = damaged
        self._waiting: deque[_WaitingQuery] = deque()
        self._at_work: _WaitingQuery | None = None
        self.process: Process | None = None
        self._life: object = None
        self._ending: set[asyncio.Task[None]] = set()
        self._failures = 0
        self._pause: asyncio.TimerHandle | None = None
        self._asked = 0
        self._stale: set[int] | None = set()
        self._closed = False
        if eager:
            self._start()

    async def ask(self, query: Query) -> Answer | Refused:
        """Queues a query and returns its answer.

        Raises:
            Problem: 503, too many wait, or no answer within the time that the service allows.
        """
        if len(self._waiting) >= MOST_WAITING:
            raise Problem(
                503,
                f"{counted(len(self._waiting), 'question')} of this scene waiting for an answer already",
                field="id",
                value=self._spec.folder.name,
                remedy="ask less often, or subscribe (WS …/stream): it sends the newest only",
                headers={"Retry-After": "1"},
            )
        if self._closed:
            return Refused(0, "the scene has ended", status=503)
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
                remedy="ask for less at once, or again later",
                headers={"Retry-After": "5"},
            ) from None
        finally:
            if turn in self._waiting:
                self._waiting.remove(turn)
            if turn is self._at_work:  # the asker has gone
                asyncio.get_running_loop().call_later(self._grace, self._give_up, turn)

    def refresh(self, frames: tuple[int, ...] | None) -> None:
        """Notes frames that were committed, deleted or taken back, for the next query; None: any may have been."""
        if frames is None or self._stale is None or len(self._stale) > MOST_STALE:
            self._stale = None
        else:
            self._stale.update(frames)

    async def stop(self, seconds: float) -> None:
        """Ends the process within `seconds`, at once if it is busy; queries that wait, and later ones, are refused."""
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
            turn.end(Refused(turn.number, "the scene has ended", status=503))

    def _start(self) -> None:
        self._life = life = object()
        ended = partial(self._process_ended, life)
        self.process = self._placement.start(self._entry, self._spec, self._answered, ended)

    def _next(self) -> None:
        """Gives the process the next query, if it is free."""
        if self._at_work is not None or self._pause is not None or self._closed or not self._waiting:
            return
        if self.process is None:
            self._start()
        assert self.process is not None
        self._at_work = self._waiting.popleft()
        stale, self._stale = None if self._stale is None else frozenset(self._stale), set()
        self.process.send(AskedQuery(self._at_work.number, self._at_work.query, stale))

    def _answered(self, message: Answer | Refused | Damaged) -> None:
        if isinstance(message, Damaged):
            self._damaged(message.files)
            return
        turn = self._at_work
        if turn is None or turn.number != message.number:  # of a process that was given up
            return
        self._failures = 0
        self._at_work = None
        turn.end(message)
        self._next()

    def _give_up(self, turn: _WaitingQuery) -> None:
        """Ends the process if it is still busy with a cancelled query."""
        if self._at_work is not turn or self.process is None:
            return
        log.warning("scene %s: a %s query was cancelled; its reader restarts", self._spec.folder.name, turn.query.kind)
        task = asyncio.ensure_future(self.process.stop(0))
        self._ending.add(task)
        task.add_done_callback(self._ending.discard)
        self.process = self._at_work = self._life = None
        self._next()

    def _process_ended(self, life: object, reason: str) -> None:
        if life is not self._life or self._closed:
            return
        metrics.RESTARTS.labels("reader").inc()
        turn, self.process, self._at_work = self._at_work, None, None
        pause = min(LONGEST_PAUSE_S, FIRST_PAUSE_S * 2**self._failures)
        self._failures += 1
        log.error("scene %s: a reader is gone (%s); the next in %g s", self._spec.folder.name, reason, pause)
        if turn is not None:
            turn.end(Refused(turn.number, f"the reader ended while it was busy with this: {reason}", status=500))
        self._pause = asyncio.get_running_loop().call_later(pause, self._go_on)

    def _go_on(self) -> None:
        self._pause = None
        self._next()


@dataclass(frozen=True, eq=False)
class Labels:
    """Part labels, computed from the frames up to one.

    Attributes:
        commits: commits that the reader knew of. frame: the last one read, as text.
    """

    commits: int
    frame: str
    labels: NDArray[np.int16]


class Readers:
    """Answers queries about a scene's committed frames.

    Attributes:
        views, bulk: the two processes.
    """

    def __init__(self, spec: SceneSpec, placement: Placement, damaged: Noticed) -> None:
        self._spec = spec
        of_all = partial(QueryQueue, spec=spec, placement=placement, damaged=damaged)
        self.views = of_all(renderer.views, eager=True, grace=GRACE_VIEWS_S)
        self.bulk = of_all(renderer.bulk, eager=False, grace=GRACE_BULK_S)
        self._commits = 0
        self._labels: OrderedDict[int | None, Labels] = OrderedDict()
        self._finding: dict[int | None, asyncio.Task[Labels]] = {}

    async def ask(self, query: Query) -> Answer:
        """Returns the answer to a query; cancelling this cancels the query.

        Raises:
            Problem: 4xx, it cannot be answered; 503, it takes too long or too many wait; 500, a fault of the reader.
        """
        began, outcome = time.perf_counter(), "failed"
        try:
            answer, outcome = await self._answer(query), "answered"
            return answer
        finally:
            metrics.ANSWER_SECONDS.labels(query.kind, outcome).observe(time.perf_counter() - began)

    async def _answer(self, query: Query) -> Answer:
        if isinstance(query, TracksQuery):
            return await self._tracks(query)
        if not isinstance(query, RenderQuery):
            return _checked(await self.bulk.ask(query), query)
        if "parts" not in query.kinds:
            return _checked(await self.views.ask(query), query)
        labels = await self._labels_of(query.parts)
        answer = _checked(await self.views.ask(replace(query, labels=labels.labels)), query)
        return replace(answer, headers={**answer.headers, "X-Parts-Frame": labels.frame})

    def refresh(self, frames: tuple[int, ...] | None = None) -> None:
        """Notes frames that were committed, deleted or taken back: these, or any of them for None."""
        self._commits += 1
        self.views.refresh(frames)
        self.bulk.refresh(frames)

    async def stop(self, seconds: float = STOP_SECONDS) -> None:
        """Ends the processes within `seconds`; queries that wait are refused."""
        for task in self._finding.values():
            task.cancel()
        await asyncio.gather(self.views.stop(seconds), self.bulk.stop(seconds))

    async def _tracks(self, query: TracksQuery) -> Answer:
        """Answers a track query; a long one in pieces, so that others come in between."""
        pieces = track_answers.pieces(query)
        if len(pieces) * len(pieces[0]) == 1:
            return _checked(await self.bulk.ask(query), query)
        answers = [[_checked(await self.bulk.ask(piece), piece).body for piece in row] for row in pieces]
        return Answer(0, *await asyncio.to_thread(track_answers.together, answers, query, self._spec))

    async def _labels_of(self, count: int | None) -> Labels:
        """Returns the part labels for a view; only the first call waits, later ones get the labels found last.

        They are found from the whole history, which takes longer than a view. After a commit they are found anew while
        views go on with those before.
        """
        known = self._labels.get(count)
        if known is not None and known.commits == self._commits:
            return known
        if count not in self._finding:
            task = asyncio.ensure_future(self._find(count))
            self._finding[count] = task
            task.add_done_callback(partial(self._found, count))
        return await asyncio.shield(self._finding[count]) if known is None else known

    async def _find(self, count: int | None) -> Labels:
        commits = self._commits
        answer = _checked(await self.bulk.ask(LabelsQuery(count)), LabelsQuery(count))
        labels = np.frombuffer(answer.body, "<i2")
        return Labels(commits, answer.headers["X-Parts-Frame"], labels)

    def _found(self, count: int | None, task: asyncio.Task[Labels]) -> None:
        del self._finding[count]
        if task.cancelled() or task.exception() is not None:
            return
        self._labels[count] = task.result()
        self._labels.move_to_end(count)
        while len(self._labels) > COUNTS_KEPT:
            self._labels.popitem(last=False)


def _checked(answer: Answer | Refused, query: Query) -> Answer:
    if isinstance(answer, Answer):
        return answer
    if answer.status != 422 and not (answer.status == 404 and isinstance(query, GaussiansQuery)):
        remedy = answer.remedy or REMEDIES[answer.status]
        headers = {"Retry-After": "1"} if answer.status == 503 else None
        raise Problem(answer.status, answer.fault, remedy=remedy, headers=headers)
    field, value = asked(query)
    remedy = answer.remedy or f"give another {field}"
    raise Problem(answer.status, answer.fault, field=field, value=value, remedy=remedy)
