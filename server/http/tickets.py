"""Tickets: a browser cannot send a bearer token with a WebSocket; it fetches a ticket and offers it as a subprotocol.

A ticket is random, lives for seconds, opens one WebSocket, and is kept in memory as a hash only. It is offered as
`scas4d.ticket.<ticket>` in Sec-WebSocket-Protocol, never in a URL, where it would end up in logs and histories.
"""

from __future__ import annotations

import hashlib
import secrets
import time
from collections.abc import Callable

from starlette.types import Message, Scope, Send

from server.problems import Problem, counted

SUBPROTOCOL = "scas4d.ticket."

TICKET_SECONDS = 30.0
"""Life of a ticket: a browser opens its WebSocket at once, on a slow link within seconds."""
MOST_TICKETS = 1024
"""Tickets that may wait to be used: some 100 bytes each, and no page needs more than a few."""


class Tickets:
    """The tickets that wait to be used.

    Args:
        clock: seconds that only rise.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._until: dict[bytes, float] = {}

    def issue(self) -> str:
        """Issues a new ticket.

        Raises:
            Problem: 429, as many wait as may.
        """
        now = self._clock()
        self._until = {digest: until for digest, until in self._until.items() if until > now}
        if len(self._until) >= MOST_TICKETS:
            raise Problem(
                429,
                f"{counted(len(self._until), 'ticket')} of at most {MOST_TICKETS} wait to be used",
                field="tickets",
                value=MOST_TICKETS,
                remedy=f"use them, or wait {TICKET_SECONDS:g} s",
                headers={"Retry-After": str(max(1, round(TICKET_SECONDS)))},
            )
        ticket = secrets.token_urlsafe(24)
        self._until[_digest(ticket)] = now + TICKET_SECONDS
        return ticket

    def redeem(self, ticket: str) -> bool:
        """Uses a ticket; returns True if it was issued, is still alive and was not used before."""
        until = self._until.pop(_digest(ticket), None)
        return until is not None and until > self._clock()


def _digest(ticket: str) -> bytes:
    return hashlib.sha256(ticket.encode("utf-8", "surrogateescape")).digest()


def take_offered(scope: Scope) -> list[str]:
    """Takes the tickets out of the subprotocols that a WebSocket offers, and returns those subprotocols."""
    offered = scope.get("subprotocols", [])
    shown = [name for name in offered if name.startswith(SUBPROTOCOL)]
    scope["subprotocols"] = [name for name in offered if name not in shown]
    scope["headers"] = [(name, value) for name, value in scope["headers"] if name != b"sec-websocket-protocol"]
    if scope["subprotocols"]:
        scope["headers"].append((b"sec-websocket-protocol", ", ".join(scope["subprotocols"]).encode("latin-1")))
    return shown


def accepting(subprotocol: str, send: Send) -> Send:
    """A sender that accepts the ticket's subprotocol where the application accepts none.

    A browser gives up a WebSocket that accepts none of the subprotocols it offered.
    """

    async def sending(message: Message) -> None:
        if message["type"] == "websocket.accept" and not message.get("subprotocol"):
            message = {**message, "subprotocol": subprotocol}
        await send(message)

    return sending
