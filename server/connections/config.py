"""Configuration of uvicorn: guarded connections, and forwarded headers from trusted proxies only."""

from __future__ import annotations

from typing import Any

import uvicorn
from fastapi import FastAPI

from server.connections.connection import Connection
from server.connections.guard import ConnectionGuard
from server.connections.websocket import Socket


def guarded(app: FastAPI, **more: Any) -> uvicorn.Config:
    """Makes the configuration of uvicorn for an application of `server.app.create_app`.

    Args:
        app: the application, which knows its guard. more: further options of uvicorn, as `port`.
    """
    guard: ConnectionGuard = app.state.guard
    proxies = [str(network) for network in guard.limits.proxies]
    of_service: dict[str, Any] = {"guard": guard}
    options: dict[str, Any] = {
        "http": type("GuardedConnection", (Connection,), of_service),
        "ws": type("GuardedSocket", (Socket,), of_service),
        "server_header": False,
        # Other peers' headers are not believed; uvicorn would believe FORWARDED_ALLOW_IPS and the loopback.
        "proxy_headers": bool(proxies),
        "forwarded_allow_ips": proxies,
        "timeout_keep_alive": guard.limits.keep_alive_seconds,
        "ws_per_message_deflate": False,  # pictures are compressed already: a hundred subscribers would cost a core
    }
    return uvicorn.Config(app, **{**options, **more})
