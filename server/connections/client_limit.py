"""Per-client limit on concurrent requests behind a trusted proxy."""

from __future__ import annotations

from collections import Counter

from starlette.types import ASGIApp, Receive, Scope, Send

from server import problems
from server.connections.guard import ConnectionGuard
from server.connections.refusals import Refusal, problem


class ClientLimit:
    """Middleware that limits the concurrent requests and WebSockets of each client address.

    Requests above the limit get 429. A trusted proxy is exempt from the limit on connections per peer. Instead,
    the same limit applies to the requests of each client that the proxy names in X-Forwarded-For. uvicorn reads this
    header from trusted proxies only.
    """

    def __init__(self, app: ASGIApp, guard: ConnectionGuard) -> None:
        self.app = app
        self.guard = guard
        self._under_way: Counter[str] = Counter()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes the request on, or responds with 429."""
        address = (scope.get("client") or ("",))[0]
        limits = self.guard.limits
        if scope["type"] not in ("http", "websocket") or limits.is_proxy(address):
            await self.app(scope, receive, send)
            return
        if self._under_way[address] >= limits.per_peer:
            self.guard.count_refusal(Refusal.CLIENT_REQUESTS)
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
