"""Retries of calls: which answers are retried, after how long, and until when.

Sent again is what does the same when it is done twice: reading, and every frame, which the service knows by its
content.

============================  =====================================================================================
429                           after the seconds that the service asks for, `busy` seconds in all; where it predicts
                              them (`retry_after_seconds`), a long wait is asked about again at half of it
502, 503, 504, 507, and a     after 0.2, 0.4, 0.8 … 5 s, each cut at random to 50…100 % so that many senders do not
connection that breaks        return together, or later where the answer says so; until `outage` seconds after the
or cannot be made             first failure of the call
every other 4xx, 500          never: the same request would be refused again
============================  =====================================================================================

What is *not* the same when done twice (making a scene) is sent again only where no connection could be made at all.
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
from client.errors import ServiceUnreachable, error_of

FIRST_WAIT_S = 0.2
LONGEST_WAIT_S = 5.0
SHORTEST_BUSY_WAIT_S = 0.1
SURE_S, LONGEST_BUSY_WAIT_S = 2.0, 10.0
"""A prediction up to the first is waited for whole, a longer one by half and at most the second: frame 0 may end sooner
than predicted, and then the rig should not sleep."""
OUTAGE_STATUSES = (502, 503, 504, 507)

BUSY_S = 3600.0
"""How long a full queue is waited for: a first frame takes minutes."""
OUTAGE_S = 20.0
"""How long a service that does not answer is waited for."""


@dataclass(frozen=True)
class Retry:
    """A wait before a call is sent again, with its reason.

    Attributes:
        reason: "busy": the service is there and has no room; "outage": it does not answer.
        seconds: that will be waited.
        detail: one sentence.
    """

    reason: Literal["busy", "outage"]
    seconds: float
    detail: str


OnRetry = Callable[[Retry], None]


class Retries:
    """Retries of one call: computes the seconds until it may be sent again, or raises."""

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
        """Seconds to wait after no answer came.

        Raises:
            ServiceUnreachable: it is over.
        """
        unsent = isinstance(error, httpx.ConnectError | httpx.ConnectTimeout)
        wait = None
        if (self.call.repeatable or unsent) and not isinstance(error, httpx.UnsupportedProtocol):
            wait = self._outage_wait(0.0, str(error))
        if wait is None:
            tries = f" after {self._failures} tries" if self._failures > 1 else ""
            what = str(error) or type(error).__name__
            raise ServiceUnreachable(f"{self._url} cannot be reached{tries}: {what}") from error
        self._lost = self._lost or not unsent
        return wait

    def after_response(self, response: httpx.Response) -> float | None:
        """Seconds to wait after an answer; None: it stands.

        Raises:
            ServiceError: the service refused.
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
                wait = self._outage_wait(asked or 0.0, f"it answered {response.status_code}")
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
        self._failed_at, self._failures = None, 0  # it answers
        return self._notify(Retry("busy", wait, problem.detail))

    def _outage_wait(self, asked: float, detail: str) -> float | None:
        now = time.monotonic()
        self._failed_at = now if self._failed_at is None else self._failed_at
        self._failures += 1
        left = self._failed_at + self._outage - now
        if left <= 0:
            return None
        # 2**n of a day without an answer would overflow a float.
        grown = FIRST_WAIT_S * 2.0 ** min(self._failures - 1, 16)
        wait = max(min(grown, LONGEST_WAIT_S) * random.uniform(0.5, 1.0), asked)
        return self._notify(Retry("outage", min(wait, left), detail))

    def _notify(self, retry: Retry) -> float:
        if self._on_retry is not None:
            self._on_retry(retry)
        return retry.seconds


def retry_after_seconds(header: str) -> float | None:
    """Seconds that a Retry-After header asks for, a number or a date; None where it cannot be read."""
    if header.strip().isdigit():
        return float(header)
    try:
        when = parsedate_to_datetime(header)
    except ValueError:
        return None
    when = when if when.tzinfo is not None else when.replace(tzinfo=UTC)
    return max(0.0, (when - datetime.now(UTC)).total_seconds())
