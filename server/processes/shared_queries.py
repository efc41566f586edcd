"""Deduplicated queries to a scene's readers on behalf of its stream subscribers."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Hashable
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np

from client.wire.stream import BinaryHead
from server.processes.queries import Answer, Query, RenderQuery, StatesQuery

QUERIES_AT_ONCE = 2
"""Maximum number of subscriber queries in flight per lane: one that is running and one that is ready to follow.

Other queries are built when their turn comes, so that they request the newest data.
"""
KEPT_ANSWERS = 64
"""Maximum number of cached answers."""
KEPT_BYTES = 32_000_000
"""Maximum total size of cached answers in bytes."""

AskReaders = Callable[[Query], Awaitable[Answer]]


@dataclass(frozen=True)
class SharedQuery:
    """Query of a live subscription at one point in time.

    Attributes:
        key: cache key, which is equal for all subscribers that would get the same answer.
        query: query to send to the readers.
        head: head of the message with the answer; its media type and headers are filled in from the answer.
        changes: number of changes that the answer covers.
    """

    key: Hashable
    query: Query
    head: BinaryHead
    changes: int


def fingerprint(value: Any) -> Hashable:
    """Returns a hashable value that is equal for equal queries.

    Dataclasses and arrays are compared by content.
    """
    if is_dataclass(value) and not isinstance(value, type):
        return (type(value).__name__, *(fingerprint(getattr(value, field.name)) for field in fields(value)))
    if isinstance(value, np.ndarray):
        return (value.shape, value.dtype.str, value.tobytes())
    if isinstance(value, list | tuple):
        return tuple(fingerprint(one) for one in value)
    hashable: Hashable = value
    return hashable


def lane(query: Query) -> str:
    """Returns the lane of a query, "views" or "bulk".

    Tracks and parts have a separate lane, because they take longer and must not delay views or live states.
    """
    quick = isinstance(query, StatesQuery) or (isinstance(query, RenderQuery) and "parts" not in query.kinds)
    return "views" if quick else "bulk"


class SharedQueries:
    """Deduplicating front end of a scene's readers, with a small cache of recent answers.

    At most `QUERIES_AT_ONCE` queries per lane are in flight. A waiting subscriber builds its query only when its turn
    comes, so a camera that moved in the meantime is rendered at its current pose. Turns are served in FIFO order, so
    that no subscriber starves another.
    """

    def __init__(self, ask: AskReaders) -> None:
        self._ask = ask
        self._turns = {lane: asyncio.Semaphore(QUERIES_AT_ONCE) for lane in ("views", "bulk")}
        self._working: dict[Hashable, asyncio.Future[Answer]] = {}
        self._kept: OrderedDict[Hashable, Answer] = OrderedDict()
        self._bytes = 0
        self.asked = 0
        """Number of queries sent to the readers so far."""

    async def answer(self, question: Callable[[], SharedQuery]) -> tuple[SharedQuery, Answer]:
        """Returns the query and its answer; `question` builds the query just before it is sent.

        Raises:
            Problem: raised by `question` or by the scene.
        """
        asked = question()
        while not self._known(asked.key):
            turns = self._turns[lane(asked.query)]
            await turns.acquire()
            begun = False
            try:
                now = question()
                # If the query has changed its lane while waiting, it must wait for a turn in the new lane.
                if not self._known(now.key) and self._turns[lane(now.query)] is turns:
                    self._begin(now.key, now.query, turns)
                    begun = True
                asked = now
            finally:
                if not begun:
                    turns.release()
        if asked.key in self._kept:
            self._kept.move_to_end(asked.key)
            return asked, self._kept[asked.key]
        # Shielded, so that cancelling one subscriber does not cancel the query for the others.
        return asked, await asyncio.shield(self._working[asked.key])

    def _known(self, key: Hashable) -> bool:
        return key in self._kept or key in self._working

    def _begin(self, key: Hashable, query: Query, turns: asyncio.Semaphore) -> None:
        def done(task: asyncio.Future[Answer]) -> None:
            turns.release()
            del self._working[key]
            if not task.cancelled() and task.exception() is None:
                self._keep(key, task.result())

        self.asked += 1
        self._working[key] = asyncio.ensure_future(self._ask(query))
        self._working[key].add_done_callback(done)

    def _keep(self, key: Hashable, answer: Answer) -> None:
        self._kept[key] = answer
        self._bytes += len(answer.body)
        while len(self._kept) > KEPT_ANSWERS or self._bytes > KEPT_BYTES:
            _, old = self._kept.popitem(last=False)
            self._bytes -= len(old.body)
