"""Exceptions that the client raises for error responses and for an unreachable service.

::

    ServiceError            error response; `problem` is the problem document
    ├── InvalidRequest      400, 405, 415, 422  a field is invalid; `problem.field` names it
    ├── TooLarge            413                 the request exceeds the size limit
    ├── NotAuthorized       401, 403            the token is missing or unknown
    ├── NotFound            404, 410            the scene, frame or camera does not exist
    ├── Conflict            409                 the current state does not allow the request
    │   └── FrameGap                            another frame must be sent first; `expected` is its index
    ├── Busy                429                 the queue stayed full longer than the busy timeout
    └── ServiceFault        5xx                 the service, or a proxy in front of it, failed
    ServiceUnreachable      no response was received
"""

from __future__ import annotations

import socket
import ssl
import urllib.request

import httpx
import websockets.exceptions

from client.wire import ProblemDetails

MAX_CAUSES = 8
"""Maximum number of chained exceptions that are examined."""
TEXT_LENGTH = 200
"""Maximum number of characters to show from a response that is not a problem document."""


class ServiceError(RuntimeError):
    """Error response from the service; `problem` contains the field, its value and a remedy."""

    def __init__(self, problem: ProblemDetails) -> None:
        remedy = f" ({problem.remedy})" if problem.remedy else ""
        super().__init__(f"{problem.status}: {problem.detail}{remedy}")
        self.problem = problem

    @property
    def status(self) -> int:
        """HTTP status code."""
        return self.problem.status


class InvalidRequest(ServiceError):
    """Error raised if a field of the request is invalid."""


class TooLarge(ServiceError):
    """Error raised if the request exceeds the size limit of the service."""


class NotAuthorized(ServiceError):
    """Error raised if the token is missing or unknown to the service."""


class NotFound(ServiceError):
    """Error raised if the scene, frame or camera does not exist."""


class Conflict(ServiceError):
    """Error raised if the current state of the scene does not allow the request."""


class FrameGap(Conflict):
    """Error raised if another frame must be sent first."""

    @property
    def expected(self) -> int:
        """Index of the frame that the service expects next."""
        return int((self.problem.model_extra or {})["expected"])


class Busy(ServiceError):
    """Error raised if the service currently has no capacity for the request."""


class ServiceFault(ServiceError):
    """Error raised if the service, or a proxy in front of it, failed."""


class ServiceUnreachable(ConnectionError):
    """Error raised if there was no response or the connection was lost.

    Attributes:
        refused: whether the connection was refused, because no program listens at the address.
    """

    def __init__(self, message: str, *, refused: bool = False) -> None:
        super().__init__(message)
        self.refused = refused


def unreachable(url: str, error: Exception, attempts: int = 1) -> ServiceUnreachable:
    """Returns the exception for a connection that failed. It says what happened, and not more than is known.

    Args:
        url: address of the service.
        error: exception of the HTTP or WebSocket library.
        attempts: number of attempts.
    """
    tries = f" after {attempts} attempts" if attempts > 1 else ""
    what = str(error) or type(error).__name__
    causes = [error]
    while (cause := causes[-1].__cause__ or causes[-1].__context__) is not None and len(causes) < MAX_CAUSES:
        causes.append(cause)  # type: ignore[arg-type]

    def is_any(*kinds: type[Exception]) -> bool:
        return any(isinstance(cause, kinds) for cause in causes)

    refused = is_any(ConnectionRefusedError)
    if is_any(httpx.ProxyError, websockets.exceptions.ProxyError):
        text = f"{url} cannot be reached{tries}, because the proxy failed: {what}"
    elif is_any(ssl.SSLError):
        text = f"{url} was reached{tries}, but the TLS handshake failed: {what}; for a service without TLS, use http://"
    elif is_any(socket.gaierror):
        text = f"{url} cannot be reached{tries}: its host name could not be resolved ({what})"
    elif refused:
        text = f"{url} cannot be reached{tries}: the connection was refused"
    elif is_any(httpx.ConnectTimeout):
        text = (
            f"{url} cannot be reached{tries}: no connection was made in time; the host or a firewall does not respond"
        )
    elif is_any(httpx.TimeoutException, TimeoutError):
        text = f"{url} did not respond in time{tries} ({what})"
    elif is_any(httpx.NetworkError, httpx.RemoteProtocolError) and not is_any(httpx.ConnectError):
        text = f"the connection to {url} was lost{tries}: {what}"
    else:
        text = f"{url} cannot be reached{tries}: {what}"
    proxy = _proxy_of(url)
    return ServiceUnreachable(
        text if proxy is None else f"{text}; through the proxy {proxy}, from the environment",
        refused=refused and proxy is None,
    )


def _proxy_of(url: str) -> str | None:
    """Returns the address of the proxy that the environment sets for a URL, without its password, or None."""
    target = httpx.URL(url)
    if urllib.request.proxy_bypass(target.host):
        return None
    proxies = urllib.request.getproxies()
    kinds = {"ws": ("ws", "socks", "https", "http"), "wss": ("wss", "socks", "https")}  # as in websockets.proxy
    proxy = next(filter(None, map(proxies.get, kinds.get(target.scheme, (target.scheme, "all")))), None)
    return None if proxy is None else proxy.rsplit("@", 1)[-1]


BY_STATUS: dict[int, type[ServiceError]] = {
    400: InvalidRequest,
    401: NotAuthorized,
    403: NotAuthorized,
    404: NotFound,
    405: InvalidRequest,
    409: Conflict,
    410: NotFound,
    413: TooLarge,
    415: InvalidRequest,
    422: InvalidRequest,
    429: Busy,
}


def error_of(response: httpx.Response) -> ServiceError:
    """Returns the exception for an error response."""
    try:
        problem = ProblemDetails.model_validate_json(response.content)
    except ValueError:
        return unexpected_response(response)
    return error_of_problem(problem)


def unexpected_response(response: httpx.Response) -> ServiceError:
    """Returns the exception for a response that is not from the service, of any status."""
    text = response.text[:TEXT_LENGTH]
    detail = f"unexpected response, which is not from the service but perhaps from a proxy or another server: {text}"
    return error_of_problem(ProblemDetails(title="unexpected response", status=response.status_code, detail=detail))


def error_of_problem(problem: ProblemDetails) -> ServiceError:
    """Returns the exception for a problem document."""
    more = problem.model_extra or {}
    # The 409 for a frame resent with different content contains both `expected` and `identity`, and is not a gap.
    if problem.status == 409 and isinstance(more.get("expected"), int) and "identity" not in more:
        return FrameGap(problem)
    fallback = ServiceFault if problem.status >= 500 else ServiceError
    return BY_STATUS.get(problem.status, fallback)(problem)
