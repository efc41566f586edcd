"""Answers queries about the committed states of a scene: its two reader processes and the queues before them.

Views have a process of their own: a long track query, or a search for parts, never stands before them. The other
process starts with its first query, runs at a lower priority, and is ended when its query was cancelled: it holds
nothing that is not on disk.
"""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from server import counters
from server.messages import SceneSpec
from server.problems import SERVICE_FAULT, Problem
from server.processes import reader_process, track_answers
from server.processes.placement import STOP_SECONDS, Placement
from server.processes.queries import (
    Answer,
    GaussiansQuery,
    LabelsQuery,
    Query,
    QueryRefused,
    RenderQuery,
    TracksQuery,
    refused_field,
)
from server.processes.query_executor import OnDamage, QueryExecutor

GRACE_VIEWS_S, GRACE_BULK_S = 10.0, 1.0
"""A process may go on for so long with a cancelled query: a new process takes a second or two to start."""
MOST_STALE = 10_000
"""Frames that are noted one by one; for more, the states are listed anew."""
COUNTS_KEPT = 8
"""Numbers of parts whose labels are kept."""

NOT_COMMITTED = "ask for a frame that the scene's status counts as committed"
REMEDIES = {404: NOT_COMMITTED, 500: SERVICE_FAULT, 503: "ask again later"}
"""Remedies by the status of an answer, where the process says none."""


@dataclass(frozen=True, eq=False)
class CachedLabels:
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

    def __init__(self, spec: SceneSpec, placement: Placement, damaged: OnDamage) -> None:
        self._spec = spec
        of_all = partial(QueryExecutor, spec=spec, placement=placement, damaged=damaged)
        self.views = of_all(reader_process.run_view_reader, grace=GRACE_VIEWS_S)
        self.bulk = of_all(reader_process.run_bulk_reader, grace=GRACE_BULK_S)
        self._commits = 0
        self._labels: OrderedDict[int | None, CachedLabels] = OrderedDict()
        self._finding: dict[int | None, asyncio.Task[CachedLabels]] = {}

    @property
    def busy(self) -> bool:
        """True while a query is not answered, or labels are being found."""
        return self.views.busy or self.bulk.busy or bool(self._finding)

    def start(self) -> None:
        """Starts the process of views before anybody asks."""
        self.views.start()

    async def ask(self, query: Query) -> Answer:
        """Returns the answer to a query; cancelling this cancels the query.

        Raises:
            Problem: 4xx, it cannot be answered; 503, it takes too long or too many wait; 500, a fault of the reader.
        """
        began, outcome = time.perf_counter(), "failed"
        try:
            answer, outcome = await self._answer(query), "answered"
            return answer
        except asyncio.CancelledError:
            outcome = "cancelled"  # by who asked: no fault
            raise
        finally:
            counters.QUERY_SECONDS.labels(query.kind, outcome).observe(time.perf_counter() - began)

    async def _answer(self, query: Query) -> Answer:
        if isinstance(query, TracksQuery):
            return await self._tracks(query)
        if not isinstance(query, RenderQuery):
            return _check_answer(await self.bulk.ask(query), query)
        if "parts" not in query.kinds:
            return _check_answer(await self.views.ask(query), query)
        labels = await self._labels_of(query.parts)
        answer = _check_answer(await self.views.ask(replace(query, labels=labels.labels)), query)
        return replace(answer, headers={**answer.headers, "X-Parts-Frame": labels.frame})

    def refresh(self, frames: tuple[int, ...] | None = None) -> None:
        """Notes frames that were committed, deleted or taken back: these, or any of them for None."""
        self._commits += 1
        for queue in (self.views, self.bulk):
            if frames is None or queue.stale is None or len(queue.stale) > MOST_STALE:
                queue.stale = None
            else:
                queue.stale.update(frames)

    async def stop(self, seconds: float = STOP_SECONDS) -> None:
        """Ends the processes within `seconds`; queries that wait are refused."""
        for task in self._finding.values():
            task.cancel()
        await asyncio.gather(self.views.stop(seconds), self.bulk.stop(seconds))

    async def _tracks(self, query: TracksQuery) -> Answer:
        """Answers a track query; a long one in pieces, so that others come in between."""
        pieces = track_answers.split_query(query)
        if len(pieces) * len(pieces[0]) == 1:
            return _check_answer(await self.bulk.ask(query), query)
        answers = [[_check_answer(await self.bulk.ask(piece), piece).body for piece in row] for row in pieces]
        return Answer(0, *await asyncio.to_thread(track_answers.join_and_encode, answers, query, self._spec))

    async def _labels_of(self, count: int | None) -> CachedLabels:
        """Returns the part labels for a view; only the first call waits, later ones get the labels found last.

        They are found from the whole history, which takes longer than a view. After a commit they are found anew while
        views go on with those before.
        """
        known = self._labels.get(count)
        if known is not None and known.commits == self._commits:
            return known
        if count not in self._finding:
            task = asyncio.ensure_future(self._start_finding(count))
            self._finding[count] = task
            task.add_done_callback(partial(self._on_labels, count))
        return await asyncio.shield(self._finding[count]) if known is None else known

    async def _start_finding(self, count: int | None) -> CachedLabels:
        commits = self._commits
        answer = _check_answer(await self.bulk.ask(LabelsQuery(count)), LabelsQuery(count))
        labels = np.frombuffer(answer.body, "<i2")
        return CachedLabels(commits, answer.headers["X-Parts-Frame"], labels)

    def _on_labels(self, count: int | None, task: asyncio.Task[CachedLabels]) -> None:
        del self._finding[count]
        if task.cancelled() or task.exception() is not None:
            return
        self._labels[count] = task.result()
        self._labels.move_to_end(count)
        while len(self._labels) > COUNTS_KEPT:
            self._labels.popitem(last=False)


def _check_answer(answer: Answer | QueryRefused, query: Query) -> Answer:
    if isinstance(answer, Answer):
        return answer
    if answer.status != 422 and not (answer.status == 404 and isinstance(query, GaussiansQuery)):
        remedy = answer.remedy or REMEDIES[answer.status]
        headers = {"Retry-After": "1"} if answer.status == 503 else None
        raise Problem(answer.status, answer.fault, remedy=remedy, headers=headers)
    field, value = refused_field(query)
    remedy = answer.remedy or f"give another {field}"
    raise Problem(answer.status, answer.fault, field=field, value=value, remedy=remedy)
