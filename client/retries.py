"""Retry policy for calls: which failures are retried, after what delay, and for how long.

Idempotent calls are retried. They include reads and frame uploads, because the service recognizes frames by their
content.

============================  =====================================================================================
429                           after the delay that the service requests, for `busy` seconds in total; if the service
                              predicts a long delay (`retry_after_seconds`), the client retries after half of it
502, 503, 504, 507, and a     after 0.2, 0.4, 0.8 … 5 s, each with a random factor of 0.5…1 so that many senders do
connection that is lost       not retry at the same time, or later if the response says so; until `outage` seconds
or cannot be made             after the first failure of the call
every other 4xx, 500          never: the same request would be refused again
============================  =====================================================================================

Calls that are *not* idempotent, such as creating a scene, are retried only if no connection was established.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Any, Literal

import httpx

from client.calls import Call
from client.errors import error_of, unreachable

FIRST_WAIT_S = 0.2
LONGEST_WAIT_S = 5.0
SHORTEST_BUSY_WAIT_S = 0.1
SURE_S, LONGEST_BUSY_WAIT_S = 2.0, 10.0
"""Predicted delay in seconds up to which the client waits the full time, and maximum wait for longer predictions.

For longer predictions, the client waits half of the delay, because frame 0 may finish earlier than predicted.
"""
OUTAGE_STATUSES = (502, 503, 504, 507)

BUSY_S = 3600.0
"""Default time in seconds to wait while the queue is full; a first frame takes minutes."""
OUTAGE_S = 20.0
"""Default time in seconds to keep retrying while the service does not respond."""


@dataclass(frozen=True)
class Retry:
    """Delay before a call is retried, with its reason.

    Attributes:
        reason: "busy" if the service has no capacity, "outage" if it does not respond.
        seconds: delay in seconds.
        detail: one-sentence description.
    """

    reason: Literal["busy", "outage"]
    seconds: float
    detail: str


OnRetry = Callable[[Retry], None]


class Retries:
    """Retry state of one call, which computes the delay before the next attempt or raises the final error."""

    def __init__(
        self, call: Call[Any], url: str, *, busy: float, outage: float, on_retry: OnRetry | None = None
    ) -> None:
        self.call = call
        self._url = url
        self._busy_left = busy
        self._outage = outage
        self._on_retry = on_retry
        self._failed_at: float | None = None
        self._failures = 0
        self._lost = False

    def after_connection_error(self, error: httpx.TransportError) -> float:
        """Returns the delay in seconds before the next attempt after a connection error.

        Raises:
            ServiceUnreachable: the call is not retried any further.
        """
        unsent = isinstance(error, httpx.ConnectError | httpx.ConnectTimeout)
        wait = None
        if (self.call.repeatable or unsent) and not isinstance(error, httpx.UnsupportedProtocol):
            wait = self._outage_wait(0.0, str(error))
        if wait is None:
            raise unreachable(self._url, error, self._failures) from error
        self._lost = self._lost or not unsent
        return wait

    def after_response(self, response: httpx.Response) -> float | None:
        """Returns the delay in seconds before the next attempt, or None if the response is final.

        Raises:
            ServiceError: the service refused the request, and the call is not retried any further.
        """
        if response.is_success or (self.call.method == "DELETE" and self._lost and response.status_code == 404):
            return None
        wait = None
        if self.call.repeatable:
            asked = retry_after_seconds(response.headers.get("Retry-After", ""))
            if response.status_code == 429:
                wait = self._busy_wait(asked, response)
            elif response.status_code in OUTAGE_STATUSES:
                self._lost = True
                wait = self._outage_wait(asked or 0.0, f"it responded with status {response.status_code}")
        if wait is None:
            raise error_of(response)
        return wait

    def _busy_wait(self, asked: float | None, response: httpx.Response) -> float | None:
        if self._busy_left <= 0:
            return None
        problem = error_of(response).problem
        asked = 1.0 if asked is None else asked
        predicted = (problem.model_extra or {}).get("retry_after_seconds")
        if isinstance(predicted, int | float):
            asked = float(predicted) if predicted <= SURE_S else min(max(SURE_S, predicted / 2), LONGEST_BUSY_WAIT_S)
        wait = max(asked, SHORTEST_BUSY_WAIT_S) * random.uniform(1.0, 1.1)
        wait = min(wait, self._busy_left)
        self._busy_left -= wait
        self._failed_at, self._failures = None, 0  # the service responded, so any outage is over
        return self._notify(Retry("busy", wait, problem.detail))

    def _outage_wait(self, asked: float, detail: str) -> float | None:
        now = time.monotonic()
        self._failed_at = now if self._failed_at is None else self._failed_at
        self._failures += 1
        left = self._failed_at + self._outage - now
        if left <= 0:
            return None
        wait = max(backoff(self._failures), asked)
        return self._notify(Retry("outage", min(wait, left), detail))

    def _notify(self, retry: Retry) -> float:
        if self._on_retry is not None:
            self._on_retry(retry)
        return retry.seconds


def backoff(failures: int) -> float:
    """Returns the delay in seconds after a number of consecutive failures, with a random factor."""
    # The exponent is limited because 2**n would overflow a float after a day of outage.
    return min(LONGEST_WAIT_S, FIRST_WAIT_S * 2.0 ** min(failures - 1, 16)) * random.uniform(0.5, 1.0)


def retry_after_seconds(header: str) -> float | None:
    """Returns the delay in seconds of a Retry-After header (number or date), or None if it cannot be parsed."""
    if header.strip().isdigit():
        return float(header)
    try:
        when = parsedate_to_datetime(header)
    except ValueError:
        return None
    when = when if when.tzinfo is not None else when.replace(tzinfo=UTC)
    return max(0.0, (when - datetime.now(UTC)).total_seconds())
