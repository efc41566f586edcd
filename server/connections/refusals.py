"""Reasons for refusing a connection, with the problem document for each."""

from __future__ import annotations

from enum import StrEnum
from http import HTTPStatus

from server import problems
from server.problems import Problem

RETRY_SECONDS = 5
"""`Retry-After` value in seconds when there are too many connections; by then, incomplete headers have timed out."""


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
                f"the request header {what} than {limit:g}{unit}",
                field="path" if refusal is Refusal.URL_SIZE else "headers",
                value=f"more than {limit:g}{unit}",
                remedy="send fewer headers" if lines else "send fewer or shorter headers, or raise SCAS4D_HEADER_KB",
            )
        case Refusal.HEAD_TIME:
            return Problem(
                408,
                f"the request header was not complete within {limit:g} s",
                field="headers",
                value=f"more than {limit:g} s",
                remedy="send the whole header at once, or raise SCAS4D_HEADER_SECONDS",
            )
        case Refusal.BODY_TIME:
            return Problem(
                408,
                f"received less than 16 kB of the request body in {limit:g} s",
                field="body",
                value=f"less than 16 kB in {limit:g} s",
                remedy="resend the request without pausing, or raise SCAS4D_BODY_SECONDS",
            )
        case Refusal.BODY_OVERHEAD:
            return Problem(
                400,
                "the chunked body has more overhead (chunk headers, extensions and trailers) than content",
                field="Transfer-Encoding",
                value="chunked",
                remedy="send chunks of at least a few hundred bytes, or set Content-Length",
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
                f"the service already has {limit:g} open connections, all in use",
                field="client",
                value=f"more than {limit:g}",
                remedy="try again later, or raise SCAS4D_MAX_CONNECTIONS",
                headers=retry,
            )
        case Refusal.MALFORMED | Refusal.PIPELINED | Refusal.UNREAD | Refusal.DISPLACED:
            return Problem(
                400,
                "the request is not valid HTTP/1.1",
                field="request",
                value="unparseable bytes",
                remedy="send a valid HTTP request (RFC 9112), without TLS",
            )


def response(refused: Problem, headers: dict[str, str]) -> bytes:
    """Returns the problem as a complete HTTP/1.1 response with `Connection: close`.

    Args:
        refused: problem to report.
        headers: default headers of all the service's responses.
    """
    status = HTTPStatus(refused.status_code)
    answer = problems.problem_response(refused.document, {**headers, **(refused.headers or {}), "Connection": "close"})
    lines = [f"HTTP/1.1 {status.value} {status.phrase}".encode()]
    lines += [name + b": " + value for name, value in answer.raw_headers]
    return b"\r\n".join([*lines, b"", bytes(answer.body)])
