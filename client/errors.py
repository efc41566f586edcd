"""Exceptions of the client: refusals of the service by kind, and a service that does not answer.

::

    ServiceError            the service refused; `problem` is its problem document
    ├── InvalidRequest      400, 405, 415, 422  a field that cannot be: change what `problem.field` names
    ├── TooLarge            413                 more than the service takes
    ├── NotAuthorized       401, 403            no token, or not one that is known
    ├── NotFound            404, 410            no such scene, frame or camera
    ├── Conflict            409                 what is there does not allow it
    │   └── FrameGap                            … because another frame comes first: `expected` is its index
    ├── Busy                429                 the queue stayed full for as long as the client was patient
    └── ServiceFault        5xx                 the service, or a proxy before it, failed
    ServiceUnreachable      nobody answered
"""

from __future__ import annotations

import httpx

from client.wire import ProblemDetails

TEXT_LENGTH = 200
"""So much is shown of an answer that is no problem document."""


class ServiceError(RuntimeError):
    """The service refused; `problem` says which field, which value, and what to do."""

    def __init__(self, problem: ProblemDetails) -> None:
        remedy = f" ({problem.remedy})" if problem.remedy else ""
        super().__init__(f"{problem.status}: {problem.detail}{remedy}")
        self.problem = problem

    @property
    def status(self) -> int:
        """HTTP status."""
        return self.problem.status


class InvalidRequest(ServiceError):
    """A field has a value that it cannot have."""


class TooLarge(ServiceError):
    """The request is larger than the service takes."""


class NotAuthorized(ServiceError):
    """The token is missing, or the service does not know it."""


class NotFound(ServiceError):
    """There is no such scene, frame or camera."""


class Conflict(ServiceError):
    """The scene's present state does not allow it."""


class FrameGap(Conflict):
    """Another frame comes first."""

    @property
    def expected(self) -> int:
        """The index that the service takes next."""
        return int((self.problem.model_extra or {})["expected"])


class Busy(ServiceError):
    """The service has no room for it now."""


class ServiceFault(ServiceError):
    """The service, or a proxy before it, failed."""


class ServiceUnreachable(ConnectionError):
    """Nobody answered, or the connection broke."""


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
    """The exception of an answer that is no success."""
    try:
        problem = ProblemDetails.model_validate_json(response.content)
    except ValueError:  # not our service, or something before it
        text = response.text[:TEXT_LENGTH]
        problem = ProblemDetails(title="unexpected answer", status=response.status_code, detail=text)
    return error_of_problem(problem)


def error_of_problem(problem: ProblemDetails) -> ServiceError:
    """The exception of a problem document."""
    more = problem.model_extra or {}
    # Other content under a known index says `expected` too, and `identity`: no frame that comes first mends that.
    if problem.status == 409 and isinstance(more.get("expected"), int) and "identity" not in more:
        return FrameGap(problem)
    fallback = ServiceFault if problem.status >= 500 else ServiceError
    return BY_STATUS.get(problem.status, fallback)(problem)
