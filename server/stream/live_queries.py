"""Live queries for states, views, tracks and parts; each has at most one query and one message in flight.

A live query is issued only after the previous answer was sent, and requests whichever frame is newest at that time.
Slow clients thus cause less load, and a dragged camera is rendered only at its current pose.
"""

from __future__ import annotations

import asyncio
import logging
from abc import ABC, abstractmethod
from collections.abc import Hashable
from typing import Any, Literal

from client.wire import RenderRequest, TracksRequest
from client.wire.base import Model
from client.wire.stream import BinaryHead, NoRequest, PartsSubscription, StreamProblem, pack
from server.problems import SERVICE_FAULT, Problem
from server.processes.queries import Answer, PartsQuery, Query, RenderQuery, StatesQuery, TracksQuery
from server.processes.shared_queries import SharedQueries, SharedQuery, fingerprint
from server.queries.render import render_query
from server.queries.tracks import tracks_query
from server.scene.scene import Scene
from server.stream.outbox import Outbox

log = logging.getLogger("scas4d.server")


class LiveQuery(ABC):
    """Live subscription to states, views, tracks or parts.

    Attributes:
        request: current request of the client.
        tag: tag that the client gave the request, echoed in every message sent for it.
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
        """Replaces the request and triggers a new answer."""
        self.request = request
        self.tag = tag
        self.change()

    def change(self) -> None:
        """Signals that there may be newer data to send."""
        self._changes += 1
        self._changed.set()

    async def run(self) -> None:
        """Issues queries and sends the answers until cancelled."""
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
                log.exception("scene %s: error in subscription %r", self.scene.id, self.id)
                fault = Problem(500, "internal error", remedy=SERVICE_FAULT)
                await self._outbox.reply(StreamProblem(id=self.id, tag=self.tag, problem=fault.document))

    async def _send_newest(self) -> None:
        asked = self._ask()
        if (asked.key, asked.head.tag) != self._sent:
            asked, answer = await self._queries.answer(self._ask)
            head = self.answered(asked.head, answer)
            self._outbox.put(
                self.id,
                lambda missed: pack(head.model_copy(update={"missed": missed, **self.when_sent(head)}), answer.body),
                missed=asked.changes - 1,
            )
            self._sent = (asked.key, head.tag)
            self.on_sent(head)
        self._changes -= asked.changes

    def _ask(self) -> SharedQuery:
        query = self.query()
        # Parts are computed from the whole history, so the same query may have a different answer after a commit.
        newest = self.scene.committed[-1] if self.needs_all_frames(query) else None
        head = self.head(query).model_copy(update={"id": self.id, "tag": self.tag})
        return SharedQuery((fingerprint(query), newest), query, head, self._changes)

    def due(self) -> bool:
        """Returns True if a query should be issued now."""
        return True

    def needs_all_frames(self, query: Query) -> bool:
        """Returns True if the answer depends on every committed frame."""
        return False

    def answered(self, head: BinaryHead, answer: Answer) -> BinaryHead:
        """Returns the head of a message, completed from the answer."""
        headers = {name.lower(): value for name, value in answer.headers.items()}
        return head.model_copy(update={"media_type": answer.media_type, "headers": headers})

    def when_sent(self, head: BinaryHead) -> dict[str, Any]:
        """Returns fields of the head whose values depend on the time of sending."""
        return {}

    def on_sent(self, head: BinaryHead) -> None:
        """Called after a message with this head was put into the outbox."""
        return

    @abstractmethod
    def query(self) -> Query:
        """Returns the query to issue now.

        Raises:
            Problem: the request is invalid.
        """

    @abstractmethod
    def head(self, query: Query) -> BinaryHead:
        """Returns the head of the message that answers the query."""


class LiveStates(LiveQuery):
    """Live compact records of the newest state: first a key frame, then what changed since the previous message."""

    request: NoRequest
    _encoder: str | None = None
    _after: int | None = None

    def query(self) -> StatesQuery:
        """Returns the query for the newest state."""
        return StatesQuery(self.scene.committed[-1], self._encoder, self._after)

    def head(self, query: Query) -> BinaryHead:
        """Returns the message head with the frame index."""
        assert isinstance(query, StatesQuery)
        return _head("states", query.frame)

    def due(self) -> bool:
        """Returns True if the newest state has not been sent yet."""
        return self._after != self.scene.committed[-1]

    def answered(self, head: BinaryHead, answer: Answer) -> BinaryHead:
        """Returns the head of a message with the frame that its records continue from."""
        self._encoder = answer.headers["X-Encoder"]
        after = answer.headers.get("X-After")
        return head.model_copy(update={"media_type": answer.media_type, "after": None if after is None else int(after)})

    def when_sent(self, head: BinaryHead) -> dict[str, Any]:
        """Returns the age of the state, and records that it was published."""
        return {"age": self.scene.updates.latencies.publish(head.frame)}

    def on_sent(self, head: BinaryHead) -> None:
        """Records which state the subscriber has."""
        self._after = head.frame


class LiveRender(LiveQuery):
    """Live view of the newest or a chosen frame from a moving camera."""

    request: RenderRequest

    def query(self) -> RenderQuery:
        """Returns the render query."""
        return render_query(self.scene, self.request)

    def head(self, query: Query) -> BinaryHead:
        """Returns the message head with the frame index."""
        assert isinstance(query, RenderQuery)
        return _head("render", query.frame)

    def needs_all_frames(self, query: Query) -> bool:
        """Returns True if the view shows parts."""
        return isinstance(query, RenderQuery) and "parts" in query.kinds


class LiveTracks(LiveQuery):
    """Live trajectories: first over all requested frames, then over newly committed ones, without gaps."""

    request: TracksRequest
    _from: int | None = None
    _at: int | None = None

    def set_request(self, request: Model, tag: int | None) -> None:
        """Replaces the request; its trajectories are sent from the first requested frame."""
        self._from = self._at = None
        super().set_request(request, tag)

    def due(self) -> bool:
        """Returns True if requested frames have not been sent yet."""
        newest, last = self.scene.committed[-1], self.request.last
        return self._from is None or (self._from <= newest and (last is None or self._from <= last))

    def query(self) -> TracksQuery:
        """Returns the query for the frames that have not been sent yet."""
        first = self.request.first if self._from is None else self._from
        if self._at is None:  # fixed at the first query, because retention may later delete the first frames
            self._at = self.scene.committed[0] if self.request.at is None else self.request.at
        return tracks_query(self.scene, self.request.model_copy(update={"first": first, "at": self._at}))

    def head(self, query: Query) -> BinaryHead:
        """Returns the message head with the first and last frame index."""
        assert isinstance(query, TracksQuery)
        return _head("tracks", query.frames[-1]).model_copy(update={"first": query.frames[0]})

    def on_sent(self, head: BinaryHead) -> None:
        """Advances to the frame after the last one that was sent."""
        self._from = head.frame + 1


class LiveParts(LiveQuery):
    """Live part labels of all Gaussians."""

    request: PartsSubscription
    _next: int | None = None

    def set_request(self, request: Model, tag: int | None) -> None:
        """Replaces the request, which is answered immediately."""
        self._next = None
        super().set_request(request, tag)

    def due(self) -> bool:
        """Returns True if enough frames were committed since the last message."""
        return self._next is None or self.scene.committed[-1] >= self._next

    def query(self) -> PartsQuery:
        """Returns the parts query."""
        return PartsQuery(self.request.count)

    def head(self, query: Query) -> BinaryHead:
        """Returns the message head with the newest frame index."""
        return _head("parts", self.scene.committed[-1])

    def needs_all_frames(self, query: Query) -> bool:
        """Returns True, since parts are computed from all frames."""
        return True

    def on_sent(self, head: BinaryHead) -> None:
        """Schedules the next message after `request.every` frames."""
        self._next = head.frame + self.request.every


def _head(kind: Literal["states", "render", "tracks", "parts"], frame: int) -> BinaryHead:
    return BinaryHead(type=kind, id="-", missed=0, frame=frame, media_type="")
