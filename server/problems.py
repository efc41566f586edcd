"""Problem documents (RFC 9457) that report the field, the value and the remedy of every error."""

from __future__ import annotations

import json
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from client.wire import ProblemDetails
from scas4d_core.rig_checks import RigError

MEDIA_TYPE = "application/problem+json"
VALUE_LENGTH = 200
"""Maximum number of characters of a value quoted in a response, since the value may be a whole point cloud."""
SERVICE_FAULT = "this is a bug in the service; see the traceback in the service log"
"""Remedy reported when the service itself failed."""


class Problem(HTTPException):
    """HTTP error whose response body is a problem document (`client.wire.ProblemDetails`).

    Args:
        status: HTTP status, 400…599.
        detail: human-readable description of the fault, in one sentence.
        remedy: human-readable advice on how to fix the fault.
        field: name of the invalid parameter or field.
        value: value that was given for the field; shortened if it is long.
        headers: additional response headers.
        more: additional members of the document, such as `expected`.
    """

    def __init__(
        self,
        status: int,
        detail: str,
        *,
        remedy: str,
        field: str | None = None,
        value: object = None,
        headers: Mapping[str, str] | None = None,
        **more: Any,
    ) -> None:
        super().__init__(status, detail, dict(headers or {}))
        self.document = ProblemDetails(
            title=HTTPStatus(status).phrase,
            status=status,
            detail=detail,
            field=field,
            value=None if value is None else quote(value),
            remedy=remedy,
            **more,
        )


def internal_error(error: Exception) -> Problem:
    """Returns the 500 problem for an unexpected error, which the caller must log."""
    return Problem(500, f"internal error: {type(error).__name__}", remedy=SERVICE_FAULT)


def rig_problem(error: RigError) -> Problem:
    """Returns the problem for an invalid rig or for settings that do not fit the rig."""
    return Problem(422, error.fault, field=error.field, value=error.value, remedy=error.remedy)


def count_noun(count: int, noun: str) -> str:
    """Returns a count followed by its noun in the singular or plural, such as "1 camera" or "2 cameras"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def quote(value: object) -> str:
    """Returns a value as text, shortened to at most `VALUE_LENGTH` characters."""
    text = value if isinstance(value, str) else repr(value)
    return text if len(text) <= VALUE_LENGTH else text[: VALUE_LENGTH - 1] + "…"


def problem_response(document: ProblemDetails, headers: Mapping[str, str] | None = None) -> Response:
    """Returns an HTTP response with the problem document.

    The body is escaped to ASCII so that it can contain lone surrogates.
    """
    body = json.dumps(document.model_dump(mode="python", exclude_none=True), ensure_ascii=True).encode()
    return Response(body, document.status, dict(headers or {}), media_type=MEDIA_TYPE)


async def refuse(problem: Problem, scope: Scope, receive: Receive, send: Send) -> None:
    """Responds to a request or a WebSocket handshake with a problem, from code outside the routes."""
    if scope["type"] == "websocket" and "websocket.http.response" not in scope.get("extensions", {}):
        # This server cannot respond to a handshake with a document. Code 1008 means policy violation, and a close
        # reason is limited to 123 bytes.
        await send({"type": "websocket.close", "code": 1008, "reason": str(problem.document.detail)[:120]})
        return
    await problem_response(problem.document, problem.headers)(scope, receive, send)
