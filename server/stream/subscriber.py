"""Client of a scene's stream, with its subscriptions and the messages generated from the scene's events."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from typing import Any, TypeVar

from pydantic import ValidationError

from client.wire import FrameState
from client.wire.base import Model
from client.wire.stream import (
    CLIENT_MESSAGE,
    REQUESTS,
    SCENE_GONE,
    SCENE_RESTARTS,
    STREAM_PROTOCOL,
    Hello,
    SceneGone,
    StreamLimits,
    StreamProblem,
    Subscribe,
    Subscribed,
    Topic,
    Unsubscribe,
    Unsubscribed,
    Update,
)
from server.http import validation
from server.hub import Channel, Event, FrameFinished
from server.problems import Problem, count_noun
from server.queries.render import MOST_PIXELS
from server.queries.tracks import MOST_POINTS
from server.scene.scene import Scene
from server.stream.live_queries import LiveParts, LiveQuery, LiveRender, LiveStates, LiveTracks
from server.stream.outbox import Outbox

T = TypeVar("T")

MAX_SUBSCRIPTIONS = 16
"""Maximum number of subscriptions per stream, enough for a page with several views.

A client that needs more can open another stream.
"""
MESSAGE_KB = 256
"""Maximum size in kB of a message from a subscriber, enough for about 8000 pixels to track."""

FIELD_PREFIX = "see docs/stream.md for all messages"

LIVE: dict[Topic, type[LiveQuery]] = {
    Topic.STATES: LiveStates,
    Topic.RENDER: LiveRender,
    Topic.TRACKS: LiveTracks,
    Topic.PARTS: LiveParts,
}


class Subscriber:
    """Subscriber to a scene on behalf of one client.

    The WebSocket route sends the messages in the outbox.

    Attributes:
        closing: code and reason for closing the connection after the last message in the outbox.
    """

    def __init__(self, scene: Scene, channel: Channel) -> None:
        self.scene = scene
        self.outbox = Outbox()
        self.closing = (SCENE_GONE, "the scene was deleted")
        self._channel = channel
        self._topics: dict[str, Topic] = {}
        self._live: dict[str, tuple[LiveQuery, asyncio.Task[None]]] = {}

    def limits(self) -> StreamLimits:
        """Returns the limits that are sent to the client."""
        return StreamLimits(
            subscriptions=MAX_SUBSCRIPTIONS,
            message_bytes=MESSAGE_KB * 1000,
            render_pixels=MOST_PIXELS,
            track_points=MOST_POINTS,
        )

    async def greet(self) -> None:
        """Sends the hello message."""
        await self.outbox.reply(Hello(protocol=STREAM_PROTOCOL, scene=self.scene.id, limits=self.limits()))

    async def handle_message(self, text: str | None) -> None:
        """Handles a message from the client; an invalid one gets an error reply and has no other effect.

        Args:
            text: text of the message, or None if a binary message was received.
        """
        id: str | None = None
        tag: int | None = None
        try:
            if text is None:
                raise Problem(
                    422, "binary messages are not supported", field="message", remedy="send JSON in text messages"
                )
            message = _validate(CLIENT_MESSAGE.validate_json, text)
            id = message.id
            if isinstance(message, Unsubscribe):
                self._known(id)
                self._end(id)
                await self.outbox.reply(Unsubscribed(id=id))
                return
            tag = message.tag
            if isinstance(message, Subscribe):
                request = self._begin(message)
                await self.outbox.reply(Subscribed(id=id))
                self._start(message, request)
            else:
                self._update(message)
        except Problem as problem:
            await self.outbox.reply(StreamProblem(id=id, tag=tag, problem=problem.document))

    def close(self) -> None:
        """Ends all subscriptions after the client has disconnected."""
        for id in list(self._topics):
            self._end(id)

    # Events of the hub.

    def on_event(self, event: Event) -> None:
        """Handles an event of the scene."""
        for id, topic in self._topics.items():
            if topic == Topic.SCENE:
                self._put_status(id)
            elif topic == Topic.FRAMES and isinstance(event, FrameFinished):
                self._put_report(id, event)
        if isinstance(event, FrameFinished) and event.report.state == FrameState.COMMITTED:
            for live, _ in self._live.values():
                live.change()

    def on_close(self, reason: str) -> None:
        """Handles the deletion of the scene."""
        self.outbox.close_with(SceneGone(reason=reason))

    def on_restart(self) -> None:
        """Handles a restart of the reconstruction.

        The client must reconnect, as after a restart of the service.
        """
        self.closing = (SCENE_RESTARTS, "the reconstruction is being restarted")
        self.outbox.close_with(None)

    # Subscriptions.

    def _known(self, id: str) -> Topic:
        if id not in self._topics:
            raise Problem(
                404,
                f"no such subscription: {id!r}",
                field="id",
                value=id,
                remedy="subscribe first, with an id of your choice",
            )
        return self._topics[id]

    def _begin(self, message: Subscribe) -> Model:
        wanted = REQUESTS[message.topic]
        request = _validate(wanted.model_validate, message.request, "request", wanted)
        if message.id not in self._topics and len(self._topics) >= MAX_SUBSCRIPTIONS:
            raise Problem(
                429,
                f"the stream already has the maximum of {count_noun(len(self._topics), 'subscription')}",
                field="subscriptions",
                value=MAX_SUBSCRIPTIONS,
                remedy="unsubscribe from another one, or open a second stream",
            )
        return request

    def _start(self, message: Subscribe, request: Model) -> None:
        self._end(message.id)
        self._topics[message.id] = message.topic
        if message.topic == Topic.SCENE:
            self._put_status(message.id)
        elif message.topic == Topic.FRAMES:
            if self.scene.committed:
                newest = self.scene.updates.with_latency(self.scene.frames[self.scene.committed[-1]].report)
                self._put_report(message.id, FrameFinished(newest))
        else:
            live = LIVE[message.topic](message.id, self.scene, self._channel.queries, self.outbox)
            live.set_request(request, message.tag)
            self._live[message.id] = (live, asyncio.create_task(live.run()))

    def _update(self, message: Update) -> None:
        topic = self._known(message.id)
        if message.id not in self._live:
            raise Problem(
                422,
                f"subscriptions to topic {topic} cannot be updated",
                field="id",
                value=message.id,
                remedy="update subscriptions to render, tracks or parts",
            )
        live, _ = self._live[message.id]
        changed = live.request.model_dump() | message.request
        live.set_request(_validate(REQUESTS[topic].model_validate, changed, "request", REQUESTS[topic]), message.tag)

    def _end(self, id: str) -> None:
        self._topics.pop(id, None)
        if id in self._live:
            self._live.pop(id)[1].cancel()
        self.outbox.drop(id)

    def _put_status(self, id: str) -> None:
        # The status is read at send time, so that a slow subscriber gets the current one.
        def make(missed: int) -> str:
            return _text("scene", id, missed, "status", self._channel.status(self.scene.status))

        self.outbox.put(id, make)

    def _put_report(self, id: str, finished: FrameFinished) -> None:
        self.outbox.put(id, lambda missed: _text("frame", id, missed, "report", finished.text))


def _text(kind: str, id: str, missed: int, name: str, value: str) -> str:
    """Returns a `SceneMessage` or `FrameMessage` around a value that was serialized once for all subscribers."""
    return f'{{"type":"{kind}","id":{json.dumps(id)},"missed":{missed},"{name}":{value}}}'


def _validate(validate: Callable[[Any], T], given: Any, within: str = "", model: object = None) -> T:
    try:
        return validate(given)
    except ValidationError as error:
        raise validation.validation_problem(
            error.errors()[0],
            model=model,
            prefix=within,
            text=given if isinstance(given, str) else None,
            schema=FIELD_PREFIX,
        ) from None
