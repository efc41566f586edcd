"""The service as a process: logs, signals, uvicorn."""

from __future__ import annotations

import logging
import os
import signal
from functools import partial

import uvicorn

from server import logs
from server.app import create_app
from server.connection import Connection, keep_freed_memory
from server.placement.local import LocalPlacement
from server.settings import ServerSettings, unknown

log = logging.getLogger("scas4d.server")


def serve(settings: ServerSettings) -> None:
    """Runs until SIGTERM or SIGINT.

    Then it takes no more connections, closes WebSockets (1012), answers what was asked, and asks the scenes' processes
    to end: each has `stop_seconds`. What they do not finish is in the frame log, and is taken up at the next start.
    """
    prepare = partial(logs.configure, settings.log_format, settings.log_level)
    prepare()
    for name in unknown(os.environ):
        log.warning("%s is no setting and was ignored; docs/operations.md lists them", name)
    keep_freed_memory()
    config = uvicorn.Config(
        create_app(settings, LocalPlacement(prepare)),
        host=settings.host,
        port=settings.port,
        http=Connection,
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,  # what a client says about itself is not believed
        timeout_graceful_shutdown=max(1, round(settings.stop_seconds)),
        ws_max_size=int(settings.max_body_mb * 1e6),
        ws_per_message_deflate=False,  # pictures are compressed already: a hundred subscribers would cost a core
    )
    # uvicorn ends gracefully and then raises the signal again, for whoever called it: here that is nobody, and the
    # process ends with status 0.
    for ending in (signal.SIGTERM, signal.SIGINT):
        signal.signal(ending, lambda *_: None)
    uvicorn.Server(config).run()
    log.info("ended")
