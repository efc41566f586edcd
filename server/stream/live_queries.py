"""Subscriptions that query the readers: views, tracks, parts. Each has one query and one message under way.

A live query asks only when its message before was sent, for the newest frame at that moment: a slow client costs less,
and a camera that is dragged is rendered where it is, not everywhere it was.
"""

from __future__ import annotations

import asyncio
import logging
from abc import ABC, abstractmethod
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any, Literal

from client.wire import RenderRequest, TracksRequest
from client.wire.base import Model
from client.wire.stream import BinaryHead, PartsSubscription, StreamProblem, pack
from server.problems import SERVICE_FAULT, Problem
from server.processes.queries import PartsQuery, Query, RenderQuery, TracksQuery
from server.processes.shared_queries import SharedQueries, fingerprint
from server.queries.render import render_query
from server.queries.tracks import tracks_query
from server.scene.scene import Scene
from server.stream.outbox import Outbox

log = logging.getLogger("scas4d.server")


@dataclass(frozen=True)
class LiveSharedQuery:
    """A query of a subscription at one moment.

    Attributes:
        key: the same for all who would get the same answer.
        head: of the message that the answer will be; media type and headers are the answer's.
        changes: how many it answers for.
    """

    key: Hashable
    query: Query
    head: BinaryHead
    changes: int


class LiveQuery(ABC):
    """One subscription to views, tracks or parts.

    Attributes:
        request: what the client asks for. tag: the client's, of that request; comes back with what is sent for it.
    """

    request: Any
    tag: int | None

    def __init__(self, id: str, scene: Scene, queries: SharedQueries, box: Outbox) -> None:
        self.id = id
        self.scene = scene
        self._queries = queries
        self._outbox = box
        self._changes = 0
        self._changed = asyncio.Event()
        self._sent: Hashable = None

    def set_request(self, request: Model, tag: int | None) -> None:
        """Changes the request from now on."""
        self.request = request
        self.tag = tag
        self.change()

    def change(self) -> None:
        """Notes that there may be something newer to send."""
        self._changes += 1
        self._changed.set()

    async def run(self) -> None:
        """Asks and sends until it is cancelled."""
        while True:
            await self._changed.wait()
            await self._outbox.sent(self.id)
            self._changed.clear()
            if not (self.scene.committed and self.due()):
                self._changes = 0
                continue
            try:
                await self._send_newest()
            except Problem as problem:
                self._changes = 0
                await self._outbox.reply(StreamProblem(id=self.id, tag=self.tag, problem=problem.document))
            except Exception:
                log.exception("scene %s, subscription %r", self.scene.id, self.id)
                fault = Problem(500, "the service failed", remedy=SERVICE_FAULT)
                await self._outbox.reply(StreamProblem(id=self.id, tag=self.tag, problem=fault.document))

    async def _send_newest(self) -> None:
        asked = self._ask()
        if (asked.key, asked.head.tag) != self._sent:
            asked, answer = await self._queries.answer(self._ask)
            headers = {name.lower(): value for name, value in answer.headers.items()}
            head = asked.head.model_copy(update={"media_type": answer.media_type, "headers": headers})
            self._outbox.put(
                self.id,
                lambda missed: pack(head.model_copy(update={"missed": missed}), answer.body),
                missed=asked.changes - 1,
            )
            self._sent = (asked.key, head.tag)
            self.on_sent(head)
        self._changes -= asked.changes

    def _ask(self) -> LiveSharedQuery:
        query = self.query()
        # Parts are found from the whole history: the same query has another answer after a commit.
        newest = self.scene.committed[-1] if self.needs_all_frames(query) else None
        head = self.head(query).model_copy(update={"id": self.id, "tag": self.tag})
        return LiveSharedQuery((fingerprint(query), newest), query, head, self._changes)

    def due(self) -> bool:
        """Returns True if there is something to ask for now."""
        return True

    def needs_all_frames(self, query: Query) -> bool:
        """Returns True if the answer depends on every committed frame."""
        return False

    def on_sent(self, head: BinaryHead) -> None:
        """Notes that the message with this head is on its way."""
        return

    @abstractmethod
    def query(self) -> Query:
        """Returns the query to ask now; raises `Problem` if the request cannot be asked."""

    @abstractmethod
    def head(self, query: Query) -> BinaryHead:
        """Returns the head of the message that answers the query."""


class LiveRender(LiveQuery):
    """A view of the newest frame, or of a chosen one, from a camera that may be moved."""

    request: RenderRequest

    def query(self) -> RenderQuery:
        """Returns the view as the reader takes it."""
        return render_query(self.scene, self.request)

    def head(self, query: Query) -> BinaryHead:
        """Names the frame."""
        assert isinstance(query, RenderQuery)
        return _head("render", query.frame)

    def needs_all_frames(self, query: Query) -> bool:
        """Returns True for parts."""
        return isinstance(query, RenderQuery) and "parts" in query.kinds


class LiveTracks(LiveQuery):
    """Trajectories: first over all frames asked for, then over those committed since; none is missed."""

    request: TracksRequest
    _from: int | None = None
    _at: int | None = None

    def set_request(self, request: Model, tag: int | None) -> None:
        """Changes the request; its trajectories are sent from their beginning."""
        self._from = self._at = None
        super().set_request(request, tag)

    def due(self) -> bool:
        """Returns True if frames within those asked for were not sent."""
        newest, last = self.scene.committed[-1], self.request.last
        return self._from is None or (self._from <= newest and (last is None or self._from <= last))

    def query(self) -> TracksQuery:
        """Asks for the frames that were not sent yet."""
        first = self.request.first if self._from is None else self._from
        if self._at is None:  # stays the same frame when the scene gives up its first ones
            self._at = self.scene.committed[0] if self.request.at is None else self.request.at
        return tracks_query(self.scene, self.request.model_copy(update={"first": first, "at": self._at}))

    def head(self, query: Query) -> BinaryHead:
        """Names the frames."""
        assert isinstance(query, TracksQuery)
        return _head("tracks", query.frames[-1]).model_copy(update={"first": query.frames[0]})

    def on_sent(self, head: BinaryHead) -> None:
        """Goes on after the last frame sent."""
        self._from = head.frame + 1


class LiveParts(LiveQuery):
    """Labels of all Gaussians."""

    request: PartsSubscription
    _next: int | None = None

    def set_request(self, request: Model, tag: int | None) -> None:
        """Changes the request, which is answered at once."""
        self._next = None
        super().set_request(request, tag)

    def due(self) -> bool:
        """Returns True if enough frames came since the last message."""
        return self._next is None or self.scene.committed[-1] >= self._next

    def query(self) -> PartsQuery:
        """Returns the number of parts as the reader takes it."""
        return PartsQuery(self.request.count)

    def head(self, query: Query) -> BinaryHead:
        """Names the newest frame."""
        return _head("parts", self.scene.committed[-1])

    def needs_all_frames(self, query: Query) -> bool:
        """Returns True: parts are found from all frames."""
        return True

    def on_sent(self, head: BinaryHead) -> None:
        """Waits for more frames before the next message."""
        self._next = head.frame + self.request.every


def _head(kind: Literal["render", "tracks", "parts"], frame: int) -> BinaryHead:
    return BinaryHead(type=kind, id="-", missed=0, frame=frame, media_type="")
