"""Queries to a scene's readers on behalf of its subscribers: equal ones are asked once."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Hashable
from dataclasses import fields, is_dataclass
from typing import Any, Protocol, TypeVar

import numpy as np

from server.processes.queries import Answer, Query, RenderQuery

QUERIES_AT_ONCE = 2
"""Queries of a lane that a scene's reader has for subscribers: one at work and one that follows at once; the others are
made up when their turn comes, for what is newest then."""
KEPT_ANSWERS = 64
KEPT_BYTES = 32_000_000

AskReaders = Callable[[Query], Awaitable[Answer]]


class SharedQuery(Protocol):
    """A query and the key that is the same for all who would get the same answer."""

    @property
    def key(self) -> Hashable:
        """Equal for equal queries."""

    @property
    def query(self) -> Query:
        """The query to the readers."""


Q = TypeVar("Q", bound=SharedQuery)


def fingerprint(value: Any) -> Hashable:
    """A value that is equal for equal queries: dataclasses by field, arrays by content."""
    if is_dataclass(value) and not isinstance(value, type):
        return (type(value).__name__, *(fingerprint(getattr(value, field.name)) for field in fields(value)))
    if isinstance(value, np.ndarray):
        return (value.shape, value.dtype.str, value.tobytes())
    if isinstance(value, list | tuple):
        return tuple(fingerprint(one) for one in value)
    if isinstance(value, dict):
        return tuple((name, fingerprint(value[name])) for name in sorted(value))
    hashable: Hashable = value
    return hashable


def lane(query: Query) -> str:
    """Returns the lane of a query: trajectories and parts take longer than views and must not stand before them."""
    return "views" if isinstance(query, RenderQuery) and "parts" not in query.kinds else "bulk"


class SharedQueries:
    """Asks the reader, `QUERIES_AT_ONCE` of a lane at a time; keeps the last answers for those who come a moment later.

    A subscriber that waits for its turn makes up the query when the turn has come: a camera that was moved meanwhile is
    asked for where it is now. Turns are given in the order of waiting, so no subscriber starves another one.
    """

    def __init__(self, ask: AskReaders) -> None:
        self._ask = ask
        self._turns = {lane: asyncio.Semaphore(QUERIES_AT_ONCE) for lane in ("views", "bulk")}
        self._working: dict[Hashable, asyncio.Future[Answer]] = {}
        self._kept: OrderedDict[Hashable, Answer] = OrderedDict()
        self._bytes = 0
        self.asked = 0
        """Queries that reached the readers."""

    async def answer(self, question: Callable[[], Q]) -> tuple[Q, Answer]:
        """Returns the query and its answer; `question` makes up the query at the moment of asking.

        Raises:
            Problem: what `question` or the scene raises.
        """
        asked = question()
        while not self._known(asked.key):
            turns = self._turns[lane(asked.query)]
            await turns.acquire()
            begun = False
            try:
                now = question()
                # Another kind of query by now: it has its own turns to wait for.
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
        # Shielded: one who leaves does not take the answer away from the others.
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
