"""Formats the logs of every process on stderr: one JSON object a line, or plain lines in a terminal.

No secret is ever in one.
"""

from __future__ import annotations

import json
import logging
import re
import sys
from datetime import UTC, datetime
from typing import Any, Literal

SECRETS = re.compile(r"(?i)(bearer\s+|scas4d\.(?:ticket|read)\.|(?:token|ticket)=)[^\s\"',;&]+")
"""A secret follows these: it is hidden wherever it appears, because clients send it and any message may quote it."""

_PLAIN = frozenset(logging.makeLogRecord({}).__dict__) | {"message", "asctime", "taskName"}


def hidden(text: str) -> str:
    """Returns the text without tokens and tickets."""
    return SECRETS.sub(r"\1***", text)


class JsonFormatter(logging.Formatter):
    """Formats records as JSON: time, level, logger, message, process, `extra`, and the traceback of an exception."""

    def format(self, record: logging.LogRecord) -> str:
        """Returns one line."""
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
        return hidden(json.dumps(entry, default=str))


class TextFormatter(logging.Formatter):
    """Formats records for people: the time of day, the level from warning on, the message."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(message)s", datefmt="%H:%M:%S")

    def format(self, record: logging.LogRecord) -> str:
        """Returns a line, or several with a traceback."""
        said = super().format(record)
        if record.levelno > logging.INFO:
            moment, _, message = said.partition(" ")
            said = f"{moment} {record.levelname.lower()}: {message}"
        return hidden(said)


def told_to_people(record: logging.LogRecord) -> bool:
    """Filters out requests that only read and succeed: a viewer or a waiting rig sends several a second."""
    return record.levelno > logging.INFO or not (
        getattr(record, "method", "") in ("GET", "HEAD") and getattr(record, "status", 500) < 400
    )


def configure(format: Literal["auto", "json", "text"] = "auto", level: str = "info") -> None:
    """Sends all logs of this process to stderr. Called first thing in the service and in each of its processes.

    Args:
        format: json; text; auto: text where stderr is a terminal, else json.
        level: debug, info, warning or error.
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
        handler.addFilter(told_to_people)
        # Its start and end; the service says both itself.
        logging.getLogger("uvicorn").setLevel(max(logging.WARNING, logging.getLogger("uvicorn").level))
    # uvicorn logs a WebSocket with its whole address; `AccessLog` logs it without what follows the question mark.
    logging.getLogger("uvicorn.error").addFilter(lambda record: '"WebSocket %s"' not in str(record.msg))
