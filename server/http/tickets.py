"""Tickets: a browser cannot send a bearer token with a WebSocket; it fetches a ticket and offers it as a subprotocol.

A ticket lives for seconds and opens one WebSocket at each service. It is offered as `scas4d.ticket.<ticket>` in
Sec-WebSocket-Protocol, never in a URL, where it would end up in logs and histories. It is signed with the token, so
that every service of a cluster knows it: a browser behind a load balancer does not choose which of them it reaches.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable

from starlette.types import Message, Scope, Send

from server.http.permissions import ALL, Permission
from server.http.sharing import ALL_SCENES
from server.http.signing import Signer
from server.problems import Problem, counted

SUBPROTOCOL = "scas4d.ticket."

TICKET_SECONDS = 30.0
"""Life of a ticket: a browser opens its WebSocket at once, on a slow link within seconds."""
MOST_TICKETS = 1024
"""Tickets that are used in that time: some 100 bytes each, and no page needs more than a few."""
ALWAYS, WRITE, READ = "0", "w", "r"


class Tickets:
    """Issues tickets, and knows those that were used.

    Args:
        secret: the token of the service; None: it has none, and nobody else knows its tickets.
        clock: seconds since the epoch. Machines of a cluster agree on them to within seconds.
    """

    def __init__(self, secret: str | None = None, clock: Callable[[], float] = time.time) -> None:
        self._clock = clock
        self._signer = Signer(secret or secrets.token_urlsafe(), "scas4d tickets")
        self._used: dict[str, float] = {}

    def issue(self, permission: Permission = ALL) -> str:
        """Issues a new ticket; its bearer may do what the bearer of the token may that asked for it."""
        may = WRITE if permission.write else READ
        scene, end = permission.scene or ALL_SCENES, str(permission.end or ALWAYS)
        until = self._clock() + TICKET_SECONDS
        return self._signer.sign(".".join((secrets.token_urlsafe(12), may, scene, end, str(round(until)))))

    def redeem(self, ticket: str) -> Permission | None:
        """Uses a ticket; returns what its bearer may do, None if it was not issued, is too old or was used before.

        Raises:
            Problem: 429, as many were used lately as may be.
        """
        text, now = self._signer.read(ticket), self._clock()
        if text is None:
            return None
        number, may, rest = text.split(".", 2)
        scene, end, until = rest.rsplit(".", 2)  # a share may be asked for any word as scene
        self._used = {used: kept for used, kept in self._used.items() if kept > now}
        if float(until) <= now or number in self._used:
            return None
        if len(self._used) >= MOST_TICKETS:
            raise Problem(
                429,
                f"{counted(len(self._used), 'ticket')} of at most {MOST_TICKETS} were used within {TICKET_SECONDS:g} s",
                field="tickets",
                value=MOST_TICKETS,
                remedy=f"wait {TICKET_SECONDS:g} s",
                headers={"Retry-After": str(max(1, round(TICKET_SECONDS)))},
            )
        self._used[number] = float(until)
        return Permission(may == WRITE, None if scene == ALL_SCENES else scene, None if end == ALWAYS else int(end))


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
