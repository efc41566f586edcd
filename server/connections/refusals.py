"""Reasons for refusing a connection, with the problem document for each."""

from __future__ import annotations

from enum import StrEnum
from http import HTTPStatus

from server import problems
from server.problems import Problem

RETRY_SECONDS = 5
"""Value of `Retry-After` in seconds if there are too many connections; by then, incomplete headers have timed out."""


class Refusal(StrEnum):
    """Reason for refusing a connection; the value is the label `reason` of `scas4d_connections_refused_total`."""

    HEAD_SIZE = "head_size"
    HEAD_LINES = "head_lines"
    URL_SIZE = "url_size"
    HEAD_TIME = "head_time"
    BODY_TIME = "body_time"
    BODY_OVERHEAD = "body_overhead"
    MALFORMED = "malformed"
    PIPELINED = "pipelined"
    UNREAD = "unread"
    PEER_CONNECTIONS = "peer_connections"
    CONNECTIONS = "connections"
    DISPLACED = "displaced"
    CLIENT_REQUESTS = "client_requests"


def problem(refusal: Refusal, limit: float = 0) -> Problem:
    """Returns the problem for a refused connection or request.

    Args:
        refusal: reason for the refusal.
        limit: limit that was exceeded, in the unit of its setting.
    """
    retry = {"Retry-After": str(RETRY_SECONDS)}
    match refusal:
        case Refusal.HEAD_SIZE | Refusal.HEAD_LINES | Refusal.URL_SIZE:
            lines = refusal is Refusal.HEAD_LINES
            what, unit = ("has more lines", "") if lines else ("is larger", " kB")
            return Problem(
                414 if refusal is Refusal.URL_SIZE else 431,
                f"the header of the request {what} than {limit:g}{unit}",
                field="path" if refusal is Refusal.URL_SIZE else "headers",
                value=f"more than {limit:g}{unit}",
                remedy="send fewer headers" if lines else "send fewer or shorter headers, or raise SCAS4D_HEADER_KB",
            )
        case Refusal.HEAD_TIME:
            return Problem(
                408,
                f"the header of the request was not complete after {limit:g} s",
                field="headers",
                value=f"more than {limit:g} s",
                remedy="send the whole header at once (SCAS4D_HEADER_SECONDS)",
            )
        case Refusal.BODY_TIME:
            return Problem(
                408,
                f"less than 16 kB of the body arrived in {limit:g} s",
                field="body",
                value=f"less than 16 kB in {limit:g} s",
                remedy="send the request again, without a pause (SCAS4D_BODY_SECONDS)",
            )
        case Refusal.BODY_OVERHEAD:
            return Problem(
                400,
                "the body has more chunk headers, extensions or trailers than content",
                field="Transfer-Encoding",
                value="chunked",
                remedy="send chunks of at least a few hundred bytes, or a Content-Length",
            )
        case Refusal.PEER_CONNECTIONS | Refusal.CLIENT_REQUESTS:
            return Problem(
                429,
                f"this address already has {limit:g} open connections or requests",
                field="client",
                value=f"more than {limit:g}",
                remedy="close some of them, or raise SCAS4D_MAX_CONNECTIONS_PER_PEER",
                headers=retry,
            )
        case Refusal.CONNECTIONS:
            return Problem(
                503,
                f"the service already has {limit:g} open connections, all of them busy",
                field="client",
                value=f"more than {limit:g}",
                remedy="try again later, or raise SCAS4D_MAX_CONNECTIONS",
                headers=retry,
            )
        case Refusal.MALFORMED | Refusal.PIPELINED | Refusal.UNREAD | Refusal.DISPLACED:
            return Problem(
                400,
                "the request is not HTTP/1.1",
                field="request",
                value="bytes that cannot be parsed",
                remedy="send a valid HTTP request (RFC 9112), without TLS",
            )


def response(refused: Problem, headers: dict[str, str]) -> bytes:
    """Returns the problem as a complete HTTP/1.1 response with `Connection: close`.

    Args:
        refused: problem to report.
        headers: default headers of every response of the service.
    """
    status = HTTPStatus(refused.status_code)
    answer = problems.problem_response(refused.document, {**headers, **(refused.headers or {}), "Connection": "close"})
    lines = [f"HTTP/1.1 {status.value} {status.phrase}".encode()]
    lines += [name + b": " + value for name, value in answer.raw_headers]
    return b"\r\n".join([*lines, b"", bytes(answer.body)])
