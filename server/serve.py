"""Entry point of the service process: sets up logging, signal handlers and uvicorn."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import os
import signal
import socket
from collections.abc import Callable
from functools import partial
from typing import Any

import uvicorn

from server.app import create_app
from server.connections.config import uvicorn_config
from server.connections.process_limits import raise_open_file_limit, retain_freed_memory
from server.health import logs
from server.processes.placement import STOP_SECONDS, Placement
from server.settings import ServerSettings, unknown_names
from server.storage.disk import lock_data

log = logging.getLogger("scas4d.server")


class Server(uvicorn.Server):
    """Uvicorn server that logs a greeting once it accepts requests.

    Args:
        config: uvicorn configuration.
        greeting: message to log.
    """

    def __init__(self, config: uvicorn.Config, greeting: str) -> None:
        super().__init__(config)
        self._greeting = greeting

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Starts the application, listens on the sockets, and logs the greeting."""
        await super().startup(sockets)
        if self.started:
            log.info(self._greeting)


def serve(settings: ServerSettings) -> None:
    """Runs the service until SIGTERM or SIGINT.

    On a signal, the service stops accepting connections, closes WebSockets (1012), completes in-flight requests, and
    asks the scenes' processes to exit within `STOP_SECONDS`. Unfinished frames remain in the frame log and are
    processed after the next start.

    Raises:
        RuntimeError: the address or the data folder is unavailable or already in use.
    """
    prepare = partial(logs.configure, settings.log_format, settings.log_level)
    prepare()
    for name in unknown_names(os.environ):
        log.warning("ignoring unknown setting %s; docs/service-settings.md lists all settings", name)
    try:
        lock_data(settings.data).release()  # early check; the application takes the lock at startup
    except OSError as error:
        raise RuntimeError(f"data folder {settings.data}: {error.strerror}; choose another one with --data") from None
    placement = _placement(settings, prepare)
    sockets = listen(settings.host, settings.port)
    asyncio.run(placement.open())  # another early check
    asyncio.run(placement.announce(settings.host, sockets[0].getsockname()[1]))
    retain_freed_memory()
    config = uvicorn_config(
        create_app(_limit_to_open_files(settings), placement),
        log_config=None,
        access_log=False,
        timeout_graceful_shutdown=max(1, round(STOP_SECONDS)),
    )
    # uvicorn shuts down gracefully and then raises the signal again for its caller. Here there is no caller, so the
    # signal is ignored and the process exits with status 0.
    for ending in (signal.SIGTERM, signal.SIGINT):
        signal.signal(ending, lambda *_: None)
    greeting = (
        f"listening; viewer at {address(settings.host, sockets)}, scenes in {settings.data}; press Ctrl-C to stop"
    )
    Server(config, greeting).run(sockets)
    log.info("stopped")


def _placement(settings: ServerSettings, prepare: Callable[[], None]) -> Placement:
    """Returns the placement of the scenes' processes.

    Raises:
        RuntimeError: the settings select a Ray cluster, but Ray is not installed.
    """
    if settings.placement == "local":
        return Placement(prepare)
    try:
        from server.cluster.ray_placement import RayPlacement
    except ModuleNotFoundError:
        raise RuntimeError(
            "placement is ray, but Ray is not installed; run pip install 'scas4d[ray]', or use --placement local"
        ) from None
    return RayPlacement(prepare, settings.placement.partition("=")[2] or None, settings)


def _limit_to_open_files(settings: ServerSettings) -> ServerSettings:
    """Returns the settings with the connection limit reduced to what the system's limit on open files allows."""
    room = raise_open_file_limit(settings.max_connections)
    if room < settings.max_connections:
        log.warning(
            "SCAS4D_MAX_CONNECTIONS is %d, but the limit on open files allows only %d connections; raise the limit on "
            "open files (ulimit -n)",
            settings.max_connections,
            room,
        )
    return settings.model_copy(update={"max_connections": room})


def listen(host: str, port: int) -> list[socket.socket]:
    """Binds a socket to each local address of the host, all on the same port, and returns the sockets.

    Raises:
        RuntimeError: the host is not an address of this machine, or the port is unavailable.
    """
    sockets: list[socket.socket] = []
    try:
        for family, kind, protocol, _, where in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
            # With port 0, all addresses use the port assigned to the first one.
            free = sockets[0].getsockname()[1] if sockets else port
            with contextlib.suppress(_AddressUnavailableError):
                sockets.append(_bind(family, kind, protocol, (where[0], free, *where[2:])))
        if not sockets:
            raise OSError(errno.EADDRNOTAVAIL, os.strerror(errno.EADDRNOTAVAIL))
    except OSError as error:
        for opened in sockets:
            opened.close()
        if error.errno == errno.EADDRINUSE:
            raise RuntimeError(
                f"port {port} of {host} is in use, perhaps by another `scas4d serve`; stop it, or choose another port: "
                f"--port {port + 1 if port < 65535 else 8000}, or 0 for any free port"
            ) from None
        raise RuntimeError(
            f"cannot listen on {host}, port {port}: {error.strerror}; choose an address of this machine (--host) and a "
            "port that this user may bind (--port)"
        ) from None
    return sockets


class _AddressUnavailableError(Exception):
    """Error for an address that is unavailable on this machine, such as ::1 if IPv6 is disabled."""


def _bind(family: int, kind: int, protocol: int, where: tuple[Any, ...]) -> socket.socket:
    try:
        opened = socket.socket(family, kind, protocol)
    except OSError:
        raise _AddressUnavailableError from None
    try:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:
            opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)  # IPv4 has a separate socket
        opened.bind(where)
    except OSError as error:
        opened.close()
        if error.errno == errno.EADDRNOTAVAIL:
            raise _AddressUnavailableError from None
        raise
    return opened


def address(host: str, sockets: list[socket.socket]) -> str:
    """Returns the URL of the service for a browser on this machine."""
    name = "127.0.0.1" if host in ("0.0.0.0", "::", "") else host
    return f"http://{f'[{name}]' if ':' in name else name}:{sockets[0].getsockname()[1]}"
