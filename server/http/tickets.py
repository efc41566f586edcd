"""Tickets: a browser cannot send a bearer token with a WebSocket; it fetches a ticket and offers it as a subprotocol.

A ticket is random, lives for seconds, opens one WebSocket, and is kept in memory as a hash only. It is offered as
`scas4d.ticket.<ticket>` in Sec-WebSocket-Protocol, never in a URL, where it would end up in logs and histories.
"""

from __future__ import annotations

import hashlib
import secrets
import time
from collections.abc import Callable

from server.problems import Problem, counted

SUBPROTOCOL = "scas4d.ticket."


class Tickets:
    """Those that wait to be used.

    Args:
        seconds: each lives so long.
        limit: so many may wait.
        clock: seconds that only rise.
    """

    def __init__(self, seconds: float, limit: int, clock: Callable[[], float] = time.monotonic) -> None:
        self.seconds = seconds
        self.limit = limit
        self._clock = clock
        self._until: dict[bytes, float] = {}

    def issue(self) -> str:
        """A new ticket.

        Raises:
            Problem: 429, as many wait as may.
        """
        now = self._clock()
        self._until = {digest: until for digest, until in self._until.items() if until > now}
        if len(self._until) >= self.limit:
            raise Problem(
                429,
                f"{counted(len(self._until), 'ticket')} of at most {self.limit} wait to be used",
                field="SCAS4D_MAX_TICKETS",
                value=self.limit,
                remedy=f"use them, or wait {self.seconds:g} s",
                headers={"Retry-After": str(max(1, round(self.seconds)))},
            )
        ticket = secrets.token_urlsafe(24)
        self._until[_digest(ticket)] = now + self.seconds
        return ticket

    def redeem(self, ticket: str) -> bool:
        """Whether it was issued, is still alive and was not used; it is used now."""
        until = self._until.pop(_digest(ticket), None)
        return until is not None and until > self._clock()


def _digest(ticket: str) -> bytes:
    return hashlib.sha256(ticket.encode("utf-8", "surrogateescape")).digest()
