"""Queries about the committed states of a scene, answered by two reader processes with one queue each.

Views and live states have their own process, so a long track or part query never delays them. The other process starts
at the first query that needs it and runs at lower priority. It is stopped if its query is cancelled, since all its data
is on disk.
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
from server.processes.shared_queries import lane

GRACE_VIEWS_S, GRACE_BULK_S = 10.0, 1.0
"""Time in seconds that a process may spend on a cancelled query; starting a new process takes 1 to 2 s."""
MOST_STALE = 10_000
"""Maximum number of changed frames to track individually; if there are more, the states folder is listed again."""
COUNTS_KEPT = 8
"""Maximum number of part counts whose labels are cached."""

NOT_COMMITTED = "request a committed frame; see the scene's status"
REMEDIES = {404: NOT_COMMITTED, 500: SERVICE_FAULT, 503: "try again later"}
"""Default remedy for each HTTP status, used if the process specifies none."""


@dataclass(frozen=True, eq=False)
class CachedLabels:
    """Cached part labels [N].

    Attributes:
        commits: value of the readers' change counter when the labels were computed.
        frame: index of the newest frame used, as text.
        labels: [N] part label of each Gaussian.
    """

    commits: int
    frame: str
    labels: NDArray[np.int16]


class Readers:
    """Reader processes that answer queries about a scene's committed frames.

    Attributes:
        views: executor of queries for views and live states.
        bulk: executor of all other queries.
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
        """Whether a query is pending or part labels are being computed."""
        return self.views.busy or self.bulk.busy or bool(self._finding)

    def start(self) -> None:
        """Starts the process for views before its first query."""
        self.views.start()

    async def ask(self, query: Query) -> Answer:
        """Returns the answer to a query; cancelling this coroutine cancels the query.

        Raises:
            Problem: 4xx if the query cannot be answered; 503 if it takes too long or the queue is full; 500 if the
                reader fails.
        """
        began, outcome = time.perf_counter(), "failed"
        try:
            answer, outcome = await self._answer(query), "answered"
            return answer
        except asyncio.CancelledError:
            outcome = "cancelled"  # by the caller, which is not a failure
            raise
        finally:
            counters.QUERY_SECONDS.labels(query.kind, outcome).observe(time.perf_counter() - began)

    async def _answer(self, query: Query) -> Answer:
        if isinstance(query, TracksQuery):
            return await self._tracks(query)
        if isinstance(query, RenderQuery) and "parts" in query.kinds:
            labels = await self._labels_of(query.parts)
            answer = _check_answer(await self.views.ask(replace(query, labels=labels.labels)), query)
            return replace(answer, headers={**answer.headers, "X-Parts-Frame": labels.frame})
        reader = self.views if lane(query) == "views" else self.bulk
        return _check_answer(await reader.ask(query), query)

    def refresh(self, frames: tuple[int, ...] | None = None) -> None:
        """Records that `frames` were committed, deleted or rolled back; None means that any frame may have changed."""
        self._commits += 1
        for queue in (self.views, self.bulk):
            if frames is None or queue.stale is None or len(queue.stale) > MOST_STALE:
                queue.stale = None
            else:
                queue.stale.update(frames)

    async def stop(self, seconds: float = STOP_SECONDS) -> None:
        """Stops both processes within `seconds` and refuses queued queries."""
        for task in self._finding.values():
            task.cancel()
        await asyncio.gather(self.views.stop(seconds), self.bulk.stop(seconds))

    async def _tracks(self, query: TracksQuery) -> Answer:
        """Answers a track query; a long one is split into pieces so that other queries can run in between."""
        pieces = track_answers.split_query(query)
        if len(pieces) * len(pieces[0]) == 1:
            return _check_answer(await self.bulk.ask(query), query)
        answers = [[_check_answer(await self.bulk.ask(piece), piece).body for piece in row] for row in pieces]
        return Answer(0, *await asyncio.to_thread(track_answers.join_and_encode, answers, query, self._spec))

    async def _labels_of(self, count: int | None) -> CachedLabels:
        """Returns the part labels for a view; only the first call waits, later calls get the latest available labels.

        Labels are computed from the whole history, which takes longer than rendering a view. After a commit, they are
        recomputed in the background while views use the previous labels.
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
    remedy = answer.remedy or f"use another {field}"
    raise Problem(answer.status, answer.fault, field=field, value=value, remedy=remedy)
