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

from server.http.permissions import ALL, Permission
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
        self._waiting: dict[bytes, tuple[float, Permission]] = {}

    def issue(self, permission: Permission = ALL) -> str:
        """Issues a new ticket; its bearer may do what the bearer of the token may that asked for it.

        Raises:
            Problem: 429, as many wait as may.
        """
        now = self._clock()
        self._waiting = {digest: ticket for digest, ticket in self._waiting.items() if ticket[0] > now}
        if len(self._waiting) >= MOST_TICKETS:
            raise Problem(
                429,
                f"{counted(len(self._waiting), 'ticket')} of at most {MOST_TICKETS} wait to be used",
                field="tickets",
                value=MOST_TICKETS,
                remedy=f"use them, or wait {TICKET_SECONDS:g} s",
                headers={"Retry-After": str(max(1, round(TICKET_SECONDS)))},
            )
        ticket = secrets.token_urlsafe(24)
        self._waiting[_digest(ticket)] = (now + TICKET_SECONDS, permission)
        return ticket

    def redeem(self, ticket: str) -> Permission | None:
        """Uses a ticket; returns what its bearer may do, None if it was not issued, is too old or was used before."""
        until, permission = self._waiting.pop(_digest(ticket), (0.0, None))
        return permission if until > self._clock() else None


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
