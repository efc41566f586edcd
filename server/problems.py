"""Problem documents (RFC 9457): every error names the field, the value and the remedy."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from client.wire import ProblemDetails
from scas4d_core.rig_checks import RigError

MEDIA_TYPE = "application/problem+json"
VALUE_LENGTH = 200
"""A value quoted in an answer is cut here: it may be a whole cloud."""
SERVICE_FAULT = "this is a fault of the service; its log has the traceback"
"""The remedy where the service failed."""


class Problem(HTTPException):
    """An error answer; `client.wire.ProblemDetails` has the fields of its document.

    Args:
        status: HTTP status, 400…599.
        detail: the fault, one sentence for a person.
        remedy: the action that helps, for a person.
        field: the parameter or field at fault.
        value: the value that was given there; it is quoted and shortened.
        headers: further headers of the answer.
        more: further members of the document, such as `expected`.
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
            value=None if value is None else quoted(value),
            remedy=remedy,
            **more,
        )


def of_rig(error: RigError) -> Problem:
    """Makes the problem of a rig, or of settings for it, that cannot work."""
    return Problem(422, error.fault, field=error.field, value=error.value, remedy=error.remedy)


def counted(count: int, noun: str) -> str:
    """Returns a number and its noun: 1 camera, 2 cameras."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def quoted(value: object) -> str:
    """Returns a value as text, short enough to be sent back."""
    text = value if isinstance(value, str) else repr(value)
    return text if len(text) <= VALUE_LENGTH else text[: VALUE_LENGTH - 1] + "…"


def answer(document: ProblemDetails, headers: Mapping[str, str] | None = None) -> Response:
    """Makes a response of the document; it is ASCII, so that lone surrogates can be quoted too."""
    body = json.dumps(document.model_dump(mode="python", exclude_none=True), ensure_ascii=True).encode()
    return Response(body, document.status, dict(headers or {}), media_type=MEDIA_TYPE)


async def refuse(problem: Problem, scope: Scope, receive: Receive, send: Send) -> None:
    """Answers a request, or a WebSocket's handshake, from outside the routes."""
    if scope["type"] == "websocket" and "websocket.http.response" not in scope.get("extensions", {}):
        # The server cannot answer a handshake with a document: 1008 is a violated policy; a reason has 123 bytes.
        await send({"type": "websocket.close", "code": 1008, "reason": str(problem.document.detail)[:120]})
        return
    await answer(problem.document, problem.headers)(scope, receive, send)


def plain_tuples(schema: Any) -> None:
    """Writes tuples of one kind as arrays of a fixed length: more tools know `items` than `prefixItems`."""
    for part in schema.values() if isinstance(schema, dict) else schema if isinstance(schema, list) else ():
        plain_tuples(part)
    if isinstance(schema, dict) and schema.get("prefixItems") and "items" not in schema:
        kinds = schema["prefixItems"]
        if isinstance(kinds, list) and all(kind == kinds[0] for kind in kinds):
            schema["items"] = schema.pop("prefixItems")[0]


def first_sentence(text: str) -> str:
    """The first sentence of a text, or what stands before its semicolon, without the stop at its end.

    >>> first_sentence("Lists all scenes; wakes none. More.")
    'Lists all scenes'
    """
    return re.split(r"[.;](?:\s|$)", " ".join(text.split()), maxsplit=1)[0]


def document(app: FastAPI) -> dict[str, Any]:
    """Returns the OpenAPI document, with summaries, the media type of errors, and the token if there is one."""
    token = app.state.settings.token is not None
    if app.openapi_schema is None:
        written = FastAPI.openapi(app)
        for path, operations in written["paths"].items():
            for operation in operations.values():
                operation["summary"] = first_sentence(operation.get("description", operation["summary"]))
                for status in RESPONSES:
                    if str(status) in operation["responses"]:
                        operation["responses"][str(status)]["content"] = {MEDIA_TYPE: {"schema": PROBLEM}}
                if token and path.startswith("/health/"):
                    operation["security"] = []
        for schema in written.get("components", {}).get("schemas", {}).values():
            plain_tuples(schema)
        if token:
            schemes = written.setdefault("components", {}).setdefault("securitySchemes", {})
            schemes["bearer"] = {"type": "http", "scheme": "bearer", "description": "SCAS4D_TOKEN of the service."}
            written["security"] = [{"bearer": []}]
    assert app.openapi_schema is not None  # FastAPI.openapi keeps what it returns
    return app.openapi_schema


RESPONSES: dict[int | str, dict[str, Any]] = {
    "4XX": {"description": "The request is wrong: field, value and remedy.", "model": ProblemDetails},
    "5XX": {"description": "The service failed, or cannot answer now.", "model": ProblemDetails},
    422: {"description": "A field has a wrong value.", "model": ProblemDetails},
}
"""Answers of every route in the OpenAPI document."""
PROBLEM = {"$ref": "#/components/schemas/ProblemDetails"}
