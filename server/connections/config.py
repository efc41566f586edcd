"""Configuration of uvicorn, which guards all connections.

Forwarded headers are accepted from trusted proxies only.
"""

from __future__ import annotations

from typing import Any

import uvicorn
from fastapi import FastAPI

from server.connections.connection import GuardedConnection
from server.connections.guard import ConnectionGuard
from server.connections.websocket import GuardedWebSocket


def uvicorn_config(app: FastAPI, **more: Any) -> uvicorn.Config:
    """Returns the uvicorn configuration for an application created by `server.app.create_app`.

    Args:
        app: application with its connection guard in `app.state.guard`.
        more: additional uvicorn options, such as `port`.
    """
    guard: ConnectionGuard = app.state.guard
    proxies = [str(network) for network in guard.limits.proxies]
    of_service: dict[str, Any] = {"guard": guard}
    options: dict[str, Any] = {
        "http": type("GuardedConnection", (GuardedConnection,), of_service),
        "ws": type("GuardedSocket", (GuardedWebSocket,), of_service),
        "server_header": False,
        # Trust only the configured proxies; by default, uvicorn trusts FORWARDED_ALLOW_IPS and loopback addresses.
        "proxy_headers": bool(proxies),
        "forwarded_allow_ips": proxies,
        "timeout_keep_alive": guard.limits.keep_alive_seconds,
        "ws_per_message_deflate": False,  # images are already compressed; for 100 subscribers it would take a core
    }
    return uvicorn.Config(app, **{**options, **more})
