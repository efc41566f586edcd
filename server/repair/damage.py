"""What was found damaged in a scene, as sentences: the newest few, so that a dying disk does not grow memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable
from enum import StrEnum

from scas4d_core.errors import without_paths
from server.health import metrics

KEPT = 100
"""Sentences."""


class DamageKind(StrEnum):
    """What was damaged."""

    STATE = "state"
    CHECKPOINT = "checkpoint"
    FIXED = "fixed"
    JOURNAL = "journal"
    FRAME = "frame"
    DEFINITION = "definition"
    POINTS = "points"


class DamageLog:
    """Of one scene. A sentence that comes again is counted, or left out where it is of the same damage.

    Args:
        said: at the start of the service.
    """

    def __init__(self, said: Iterable[str] = ()) -> None:
        self._said: OrderedDict[str, int] = OrderedDict()
        self._more = 0
        for sentence in said:
            self._keep(without_paths(sentence))

    def say(self, kind: DamageKind, sentence: str, *, lasting: bool = False) -> None:
        """One more. `lasting`: nothing mends it, and it is found again each time that it is looked at."""
        sentence = without_paths(sentence)
        if lasting and sentence in self._said:
            return
        metrics.DAMAGE.labels(kind.value).inc()
        self._keep(sentence)

    def _keep(self, sentence: str) -> None:
        self._said[sentence] = self._said.pop(sentence, 0) + 1
        while len(self._said) > KEPT:
            self._said.popitem(last=False)
            self._more += 1

    @property
    def sentences(self) -> list[str]:
        """The newest, in order; the first one says how many came before them."""
        before = [f"{self._more} more before these; the service's log has them"] if self._more else []
        return [*before, *(said if count == 1 else f"{said} ({count} times)" for said, count in self._said.items())]
