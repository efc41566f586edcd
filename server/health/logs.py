"""Log formatting for all processes: one JSON object per line on stderr, or plain text in a terminal.

Secrets are masked.
"""

from __future__ import annotations

import json
import logging
import re
import sys
from datetime import UTC, datetime
from typing import Any, Literal

from client.wire.base import escaped

SECRETS = re.compile(r"(?i)(bearer\s+|scas4d\.(?:ticket|read)\.|(?:token|ticket)=)[^\s\"',;&]+")
"""Pattern of secrets and the text before them. Secrets are masked in all messages, since any may quote a request."""

_PLAIN = frozenset(logging.makeLogRecord({}).__dict__) | {"message", "asctime", "taskName"}


def redact(text: str) -> str:
    """Returns the text with tokens and tickets masked."""
    return SECRETS.sub(r"\1***", text)


class JsonFormatter(logging.Formatter):
    """Formatter that writes time, level, logger, message, process ID, `extra` fields and any traceback as JSON."""

    def format(self, record: logging.LogRecord) -> str:
        """Returns the record as one line of JSON."""
        entry: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            "process": record.process,
        }
        entry |= {name: value for name, value in record.__dict__.items() if name not in _PLAIN and name[0] != "_"}
        if record.exc_info:
            entry["exception"] = self.formatException(record.exc_info)
        return redact(json.dumps(entry, default=str))


class TextFormatter(logging.Formatter):
    """Formatter for human readers, with the time of day, the message and, for warnings and above, the level.

    Control characters of the message are escaped, because it may quote a request.
    """

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(message)s", datefmt="%H:%M:%S")

    def formatMessage(self, record: logging.LogRecord) -> str:
        """Returns the time and the message as one line."""
        return escaped(super().formatMessage(record))

    def format(self, record: logging.LogRecord) -> str:
        """Returns the record as one line, or several lines if it has a traceback."""
        said = super().format(record)
        if record.levelno > logging.INFO:
            moment, _, message = said.partition(" ")
            said = f"{moment} {record.levelname.lower()}: {message}"
        return redact(said)


def is_worth_showing(record: logging.LogRecord) -> bool:
    """Returns whether a log record is shown in a terminal.

    Successful read requests are not shown, because a viewer or a waiting rig sends several of them
    per second.
    """
    return record.levelno > logging.INFO or not (
        getattr(record, "method", "") in ("GET", "HEAD") and getattr(record, "status", 500) < 400
    )


def configure(format: Literal["auto", "json", "text"] = "auto", level: str = "info") -> None:
    """Configures logging to stderr; call it first in the service and in each of its processes.

    Args:
        format: log format; auto selects text if stderr is a terminal, otherwise json.
        level: minimum level to log: debug, info, warning or error.
    """
    text = format == "text" or (format == "auto" and sys.stderr.isatty())
    handler = logging.StreamHandler()
    handler.setFormatter(TextFormatter() if text else JsonFormatter())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.WARNING)
    for name in ("scas4d", "uvicorn"):
        logging.getLogger(name).setLevel(level.upper())
    if text:
        handler.addFilter(is_worth_showing)
        # uvicorn logs its startup and shutdown at INFO, but the service logs both itself.
        logging.getLogger("uvicorn").setLevel(max(logging.WARNING, logging.getLogger("uvicorn").level))
    # uvicorn logs the URL of a WebSocket including its query; `AccessLog` logs it without the query.
    logging.getLogger("uvicorn.error").addFilter(lambda record: '"WebSocket %s"' not in str(record.msg))
