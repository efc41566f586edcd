"""Compaction of a scene's older states by its worker, while the worker waits for messages."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

from client.wire import IngestSettings
from scas4d_core.compact import Bounds, FileHeader
from scas4d_core.storage.compaction import Compaction
from scas4d_core.storage.history import History
from server.messages import SceneSpec
from server.processes.compact_answers import compact_head
from server.storage.disk import no_room

BEHIND = 8
"""Number of states due for compaction above which one is compacted although there is other work."""

log = logging.getLogger("scas4d.worker")


class StateCompactor:
    """Compactor that converts the states of a scene to the compact format.

    The first state and the newest states stay exact.

    Args:
        spec: scene specification. If ``retention.exact_states`` is None, all states stay exact.
    """

    def __init__(self, spec: SceneSpec) -> None:
        self._spec = spec
        self._rules = spec.retention
        self._compaction: Compaction | None = None
        self._failed = False

    def set_rules(self, rules: IngestSettings) -> None:
        """Applies new retention rules from now on."""
        self._rules = rules
        if self._compaction is not None:
            self._compaction.close()
        self._compaction = None

    def compact_while_idle(self, history: History, waits: Callable[[], bool]) -> None:
        """Compacts due states until there is other work.

        If more than `BEHIND` states are due, one state is compacted in any case.
        If the disk is full, the next call tries again.

        Args:
            history: the scene's committed states.
            waits: function that returns whether a message is waiting or a commit is being written.
        """
        exact = self._rules.exact_states
        if self._failed or exact is None:
            return
        try:
            if self._compaction is None:
                self._compaction = Compaction(history, lambda: self._head(history), exact)
            while (due := self._compaction.due) and (due > BEHIND or not waits()):
                if self._compaction.step() is None or waits():
                    return
        except Exception as error:  # compaction is optional, so the scene continues with exact states
            if no_room(error):
                log.warning("scene %s: cannot compact states: %s", self._spec.folder.name, error)
                return
            log.exception("scene %s: compaction is disabled until its worker restarts", self._spec.folder.name)
            self._failed = True

    def _head(self, history: History) -> FileHeader:
        bounds = Bounds(**self._rules.state_bounds.model_dump())
        return replace(compact_head(self._spec, history), bounds=bounds)
