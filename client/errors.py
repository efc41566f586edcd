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

import httpx

from client.wire import ProblemDetails

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
    """Error raised if there was no response or the connection was lost."""


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
    except ValueError:  # not from our service, e.g. from a proxy in front of it
        text = response.text[:TEXT_LENGTH]
        problem = ProblemDetails(title="unexpected response", status=response.status_code, detail=text)
    return error_of_problem(problem)


def error_of_problem(problem: ProblemDetails) -> ServiceError:
    """Returns the exception for a problem document."""
    more = problem.model_extra or {}
    # The 409 for a frame resent with different content contains both `expected` and `identity`, and is not a gap.
    if problem.status == 409 and isinstance(more.get("expected"), int) and "identity" not in more:
        return FrameGap(problem)
    fallback = ServiceFault if problem.status >= 500 else ServiceError
    return BY_STATUS.get(problem.status, fallback)(problem)
