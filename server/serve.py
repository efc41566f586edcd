"""Runs the service as a process: logs, signals, uvicorn."""

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
from server.connections.config import guarded
from server.connections.process import keep_freed_memory, room_for_connections
from server.health import logs
from server.processes.placement import STOP_SECONDS, Placement
from server.settings import ServerSettings, unknown
from server.storage.disk import lock_data

log = logging.getLogger("scas4d.server")


class Server(uvicorn.Server):
    """uvicorn's server, which logs its address in a sentence.

    Args:
        config: of uvicorn.
        greeting: the sentence that is logged once requests are answered.
    """

    def __init__(self, config: uvicorn.Config, greeting: str) -> None:
        super().__init__(config)
        self._greeting = greeting

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Starts the application and listens."""
        await super().startup(sockets)
        if self.started:
            log.info(self._greeting)


def serve(settings: ServerSettings) -> None:
    """Runs until SIGTERM or SIGINT.

    Then it takes no more connections, closes WebSockets (1012), answers what was asked, and asks the scenes' processes
    to end: each has `STOP_SECONDS`. What they do not finish is in the frame log, and is taken up at the next start.

    Raises:
        RuntimeError: the address or the data folder is in use, or cannot be had.
    """
    prepare = partial(logs.configure, settings.log_format, settings.log_level)
    prepare()
    for name in unknown(os.environ):
        log.warning("%s is no setting and was ignored; docs/operations.md lists them", name)
    try:
        lock_data(settings.data).release()  # said here in a sentence; taken for good when the application starts
    except OSError as error:
        raise RuntimeError(f"data folder {settings.data}: {error.strerror}; name another with --data") from None
    placement = _placement(settings, prepare)
    sockets = listen(settings.host, settings.port)
    asyncio.run(placement.open())  # said here in a sentence, too
    asyncio.run(placement.announce(settings.host, sockets[0].getsockname()[1]))
    keep_freed_memory()
    config = guarded(
        create_app(_with_files(settings), placement),
        log_config=None,
        access_log=False,
        timeout_graceful_shutdown=max(1, round(STOP_SECONDS)),
    )
    # uvicorn ends gracefully and then raises the signal again, for its caller: here there is none, and the
    # process ends with status 0.
    for ending in (signal.SIGTERM, signal.SIGINT):
        signal.signal(ending, lambda *_: None)
    greeting = (
        f"listening; viewer at {address(settings.host, sockets)}, scenes in {settings.data}; Ctrl-C ends the service"
    )
    Server(config, greeting).run(sockets)
    log.info("ended")


def _placement(settings: ServerSettings, prepare: Callable[[], None]) -> Placement:
    """Makes the placement of scenes' processes.

    Raises:
        RuntimeError: on a Ray cluster, and Ray is not installed.
    """
    if settings.placement == "local":
        return Placement(prepare)
    try:
        from server.cluster.ray_placement import RayPlacement
    except ModuleNotFoundError:
        raise RuntimeError(
            "placement is ray, and Ray is not installed; pip install 'scas4d[ray]', or take --placement local"
        ) from None
    return RayPlacement(prepare, settings.placement.partition("=")[2] or None, settings)


def _with_files(settings: ServerSettings) -> ServerSettings:
    """Lowers the limit of connections to the number of files that may be open for them."""
    room = room_for_connections(settings.max_connections)
    if room < settings.max_connections:
        log.warning(
            "SCAS4D_MAX_CONNECTIONS is %d, but files may be open for %d connections only; raise the limit on open "
            "files (ulimit -n)",
            settings.max_connections,
            room,
        )
    return settings.model_copy(update={"max_connections": room})


def listen(host: str, port: int) -> list[socket.socket]:
    """Binds sockets to every address of the host that this machine has, all at one port; uvicorn listens at them.

    Raises:
        RuntimeError: there is no such address, or the port cannot be had.
    """
    sockets: list[socket.socket] = []
    try:
        for family, kind, protocol, _, where in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
            # With port 0 all addresses get the port of the first.
            free = sockets[0].getsockname()[1] if sockets else port
            with contextlib.suppress(_NotHere):
                sockets.append(_bound(family, kind, protocol, (where[0], free, *where[2:])))
        if not sockets:
            raise OSError(errno.EADDRNOTAVAIL, os.strerror(errno.EADDRNOTAVAIL))
    except OSError as error:
        for opened in sockets:
            opened.close()
        if error.errno == errno.EADDRINUSE:
            raise RuntimeError(
                f"port {port} of {host} is in use, perhaps by another `scas4d serve`; stop that, or take another port: "
                f"--port {port + 1 if port < 65535 else 8000}, or 0 for any that is free"
            ) from None
        raise RuntimeError(
            f"cannot listen at {host}, port {port}: {error.strerror}; give an address of this machine (--host) and a "
            "port that this user may take (--port)"
        ) from None
    return sockets


class _NotHere(Exception):
    """An address that this machine does not have, as ::1 where IPv6 is off."""


def _bound(family: int, kind: int, protocol: int, where: tuple[Any, ...]) -> socket.socket:
    try:
        opened = socket.socket(family, kind, protocol)
    except OSError:
        raise _NotHere from None
    try:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:
            opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)  # IPv4 has a socket of its own
        opened.bind(where)
    except OSError as error:
        opened.close()
        if error.errno == errno.EADDRNOTAVAIL:
            raise _NotHere from None
        raise
    return opened


def address(host: str, sockets: list[socket.socket]) -> str:
    """Returns the address of the service for a browser on this machine."""
    name = "127.0.0.1" if host in ("0.0.0.0", "::", "") else host
    return f"http://{f'[{name}]' if ':' in name else name}:{sockets[0].getsockname()[1]}"
