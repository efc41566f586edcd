"""Limits the requests of each client behind a trusted proxy to the connections that a peer may have."""

from __future__ import annotations

from collections import Counter

from starlette.types import ASGIApp, Receive, Scope, Send

from server import problems
from server.connections.guard import ConnectionGuard
from server.connections.refusals import Refusal, problem


class ClientLimit:
    """Counts requests and WebSockets under way by the address of their client, and answers 429 above the limit.

    A proxy's connections are not counted as one peer's; instead each client that it names (X-Forwarded-For, read by
    uvicorn from trusted proxies alone) is held to the same number.
    """

    def __init__(self, app: ASGIApp, guard: ConnectionGuard) -> None:
        self.app = app
        self.guard = guard
        self._under_way: Counter[str] = Counter()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes the request on, or refuses it."""
        address = (scope.get("client") or ("",))[0]
        limits = self.guard.limits
        if scope["type"] not in ("http", "websocket") or limits.is_proxy(address):
            await self.app(scope, receive, send)
            return
        if self._under_way[address] >= limits.per_peer:
            self.guard.refused(Refusal.CLIENT_REQUESTS)
            refused = problem(Refusal.CLIENT_REQUESTS, limits.of_refusal(Refusal.CLIENT_REQUESTS))
            await problems.refuse(refused, scope, receive, send)
            return
        self._under_way[address] += 1
        try:
            await self.app(scope, receive, send)
        finally:
            self._under_way[address] -= 1
            if not self._under_way[address]:
                del self._under_way[address]
