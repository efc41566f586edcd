"""Messages that wait for one subscriber: replies in order, and of each subscription the newest message only."""

from __future__ import annotations

import asyncio
from collections import OrderedDict, deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from client.wire.base import Model
from server.counters import STREAM_MISSED

MAX_UNSENT_REPLIES = 64
"""A client that sends without reading is not listened to until it has read down to so many replies."""

Make = Callable[[int], str | bytes]
"""A message, made when it is sent, from how many it took the place of."""


@dataclass(frozen=True)
class _Slot:
    make: Make
    missed: int
    weight: int


class Outbox:
    """Unsent messages of a subscriber, for one event loop. It is bounded by the number of subscriptions."""

    def __init__(self) -> None:
        self._replies: deque[str] = deque()
        self._slots: OrderedDict[str, _Slot] = OrderedDict()
        self._sending: str | None = None
        self._news = asyncio.Condition()
        self._poster = asyncio.Event()
        self._last = False

    async def reply(self, message: Model) -> None:
        """Adds what must arrive; waits while too much of that is unsent."""
        async with self._news:
            await self._news.wait_for(lambda: len(self._replies) < MAX_UNSENT_REPLIES)
        self._reply(message)

    def close_with(self, message: Model | None) -> None:
        """Adds the last message, if there is one; what else waits is forgotten."""
        self._replies.clear()
        self._slots.clear()
        if message is not None:
            self._reply(message)
        self._last = True
        self._poster.set()

    def put(self, id: str, make: Make, *, missed: int = 0, weight: int = 1) -> None:
        """Sets the newest message of a subscription.

        Args:
            missed: what it took the place of before it came here.
            weight: what it adds to the count of the next one if that takes its place unsent.
        """
        if self._last:
            return
        old = self._slots.get(id)
        STREAM_MISSED.inc(missed + (0 if old is None else old.weight))
        if old is not None:
            missed += old.missed + old.weight
        # In the old one's place: what changes often does not have to wait behind everything else each time.
        self._slots[id] = _Slot(make, missed, weight)
        self._poster.set()

    def drop(self, id: str) -> None:
        """Forgets what waits of a subscription."""
        self._slots.pop(id, None)

    async def sent(self, id: str) -> None:
        """Waits until nothing of a subscription is unsent."""
        async with self._news:
            await self._news.wait_for(lambda: id not in self._slots and self._sending != id)

    async def send_all(self, send: Callable[[str | bytes], Awaitable[None]]) -> None:
        """Sends until the last message is out, one after the other, replies first.

        Args:
            send: a coroutine function that waits for the connection; what is put meanwhile is newer.
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
