"""Outgoing messages of one subscriber: all replies in order, but only the newest message of each subscription."""

from __future__ import annotations

import asyncio
from collections import OrderedDict, deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from client.wire.base import Model
from server.counters import STREAM_MISSED

MAX_UNSENT_REPLIES = 64
"""Maximum number of unsent replies.

At this limit, the service stops reading from the client until the client has read some of them.
"""

Make = Callable[[int], str | bytes]
"""Function that builds a message just before it is sent, given the number of messages that it replaces."""


@dataclass(frozen=True)
class _Slot:
    make: Make
    missed: int
    weight: int


class Outbox:
    """Queue of unsent messages to a subscriber; its size is bounded by the number of subscriptions and replies."""

    def __init__(self) -> None:
        self._replies: deque[str] = deque()
        self._slots: OrderedDict[str, _Slot] = OrderedDict()
        self._sending: str | None = None
        self._news = asyncio.Condition()
        self._poster = asyncio.Event()
        self._last = False

    async def reply(self, message: Model) -> None:
        """Adds a message that must not be skipped; waits while `MAX_UNSENT_REPLIES` replies are unsent."""
        async with self._news:
            await self._news.wait_for(lambda: len(self._replies) < MAX_UNSENT_REPLIES)
        self._reply(message)

    def close_with(self, message: Model | None) -> None:
        """Discards all unsent messages and adds an optional last message."""
        self._replies.clear()
        self._slots.clear()
        if message is not None:
            self._reply(message)
        self._last = True
        self._poster.set()

    def put(self, id: str, make: Make, *, missed: int = 0, weight: int = 1) -> None:
        """Sets the newest message of a subscription, replacing its unsent message, if any.

        Args:
            id: id of the subscription.
            make: function that builds the message when it is sent.
            missed: number of messages that this message replaced before it was added.
            weight: number added to the `missed` count of the next message if this message is replaced before it is
                sent.
        """
        if self._last:
            return
        old = self._slots.get(id)
        STREAM_MISSED.inc(missed + (0 if old is None else old.weight))
        if old is not None:
            missed += old.missed + old.weight
        # Keeps the position of the replaced message, so that a frequently replaced message is not always the last.
        self._slots[id] = _Slot(make, missed, weight)
        self._poster.set()

    def drop(self, id: str) -> None:
        """Discards the unsent message of a subscription, if any."""
        self._slots.pop(id, None)

    async def sent(self, id: str) -> None:
        """Waits until a subscription has no unsent message."""
        async with self._news:
            await self._news.wait_for(lambda: id not in self._slots and self._sending != id)

    async def send_all(self, send: Callable[[str | bytes], Awaitable[None]]) -> None:
        """Sends messages one at a time, replies first, until the last message has been sent.

        Args:
            send: coroutine function that returns once the connection has accepted the message.
        """
        while True:
            await self._poster.wait()
            message: str | bytes
            if self._replies:
                message = self._replies.popleft()
            elif self._slots:
                self._sending, slot = self._slots.popitem(last=False)
                message = slot.make(slot.missed)
            else:
                self._poster.clear()
                if self._last:
                    return
                continue
            try:
                await send(message)
            finally:
                self._sending = None
            async with self._news:
                self._news.notify_all()

    def _reply(self, message: Model) -> None:
        self._replies.append(message.model_dump_json(exclude_none=True))
        self._poster.set()
