"""Tickets that browsers use to authenticate WebSockets.

A browser cannot send a bearer token when it opens a WebSocket, so it fetches a ticket and offers it as a subprotocol.
A ticket is valid for a few seconds and opens one WebSocket per service. It is sent as `scas4d.ticket.<ticket>` in
Sec-WebSocket-Protocol and never in a URL, which would end up in logs and browser histories. Tickets are signed with the
service's token, so every service in a cluster accepts them, wherever a load balancer routes the browser.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable

from itsdangerous import BadData, URLSafeSerializer
from starlette.types import Message, Scope, Send

from server.http.permissions import ALL, Permission
from server.http.sharing import HMAC_SHA256
from server.problems import Problem, count_noun

SUBPROTOCOL = "scas4d.ticket."

TICKET_SECONDS = 30.0
"""Lifetime of a ticket in seconds; even on a slow link, a browser opens its WebSocket within a few seconds."""
MOST_TICKETS = 1024
"""Maximum number of tickets used within one lifetime. Each takes about 100 bytes, and a page needs only a few."""


class Tickets:
    """Issuer and verifier of tickets, which remembers used tickets until they expire.

    Args:
        secret: the service's token. If None, only this service accepts its tickets.
        clock: function that returns the time in seconds since the epoch; clocks in a cluster must agree within seconds.
    """

    def __init__(self, secret: str | None = None, clock: Callable[[], float] = time.time) -> None:
        self._clock = clock
        secret = secret or secrets.token_urlsafe()
        self._serializer = URLSafeSerializer(secret, salt="scas4d tickets", signer_kwargs=HMAC_SHA256)
        self._used: dict[str, float] = {}

    def issue(self, permission: Permission = ALL) -> str:
        """Returns a new ticket with the permission of the client that requested it."""
        return self._serializer.dumps([secrets.token_urlsafe(12), self._clock() + TICKET_SECONDS, permission])

    def redeem(self, ticket: str) -> Permission | None:
        """Consumes a ticket and returns its permission, or None if it is unknown, expired or already used.

        Raises:
            Problem: 429 if `MOST_TICKETS` were used recently.
        """
        now = self._clock()
        try:
            number, until, permission = self._serializer.loads(ticket.encode(errors="replace"))
        except BadData:  # also a signed ticket of another version
            return None
        self._used = {used: kept for used, kept in self._used.items() if kept > now}
        if until <= now or number in self._used:
            return None
        if len(self._used) >= MOST_TICKETS:
            raise Problem(
                429,
                f"{count_noun(len(self._used), 'ticket')} used (maximum {MOST_TICKETS} in {TICKET_SECONDS:g} s)",
                field="tickets",
                value=MOST_TICKETS,
                remedy=f"try again in {TICKET_SECONDS:g} s",
                headers={"Retry-After": str(max(1, round(TICKET_SECONDS)))},
            )
        self._used[number] = until
        return Permission(*permission)


def take_offered(scope: Scope) -> list[str]:
    """Removes the tickets from the subprotocols offered by a WebSocket, and returns them."""
    offered = scope.get("subprotocols", [])
    shown = [name for name in offered if name.startswith(SUBPROTOCOL)]
    scope["subprotocols"] = [name for name in offered if name not in shown]
    scope["headers"] = [(name, value) for name, value in scope["headers"] if name != b"sec-websocket-protocol"]
    if scope["subprotocols"]:
        scope["headers"].append((b"sec-websocket-protocol", ", ".join(scope["subprotocols"]).encode("latin-1")))
    return shown


def accept_subprotocol(subprotocol: str, send: Send) -> Send:
    """Wraps `send` to accept the ticket's subprotocol if the application accepts none.

    A browser closes a WebSocket if the server accepts none of the offered subprotocols.
    """

    async def sending(message: Message) -> None:
        if message["type"] == "websocket.accept" and not message.get("subprotocol"):
            message = {**message, "subprotocol": subprotocol}
        await send(message)

    return sending
