"""Compaction of a scene's older states by a thread of its worker, beside the updates."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import replace

from client.wire import IngestSettings
from scas4d_core.compact import Bounds, FileHeader
from scas4d_core.storage.compaction import Compaction, DueState
from scas4d_core.storage.history import History
from server.messages import SceneSpec
from server.processes.compact_answers import compact_head
from server.storage.disk import no_room

BEHIND = 8
"""Number of states due for compaction above which one is compacted although a frame or commit is waiting.

With twice as many, the worker waits for each state, so that the number of exact states is bounded.
"""

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
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="compact")
        self._writing: tuple[DueState, Future[None]] | None = None

    def set_rules(self, rules: IngestSettings) -> None:
        """Applies new retention rules from now on."""
        self.wait()
        self._rules = rules
        if self._compaction is not None:
            self._compaction.close()
        self._compaction = None

    @property
    def at_work(self) -> bool:
        """Whether a state is being compacted."""
        return self._writing is not None

    def wait(self, seconds: float | None = None) -> None:
        """Waits until no state is being compacted, at most the given time.

        Call it before files of states are deleted or rewritten.
        """
        if self._writing is not None:
            wait([self._writing[1]], seconds)
            self._finish()

    def compact(self, history: History, waits: Callable[[], bool]) -> None:
        """Starts to compact a state that is due, unless there is other work. The worker calls it again and again.

        If more than `BEHIND` states are due, one state is compacted in any case.
        If the disk is full, a later call tries again.

        Args:
            history: the scene's committed states.
            waits: function that returns whether a message is waiting or a commit is being written.
        """
        exact = self._rules.exact_states
        if self._failed or exact is None:
            return
        if self._compaction is None:
            self._compaction = Compaction(history, lambda: self._head(history), exact)
        if self._writing is not None and self._compaction.due > 2 * BEHIND:
            wait([self._writing[1]])
        if not self._finish():
            return
        if self._writing is None and (due := self._compaction.due) and (due > BEHIND or not waits()):
            state = self._compaction.begin()
            if state is not None:
                self._writing = state, self._thread.submit(self._compaction.write, state)

    def _finish(self) -> bool:
        """Deletes the own file of a state that is in a compact file now; returns False if it was not compacted."""
        if self._writing is None or not self._writing[1].done():
            return True
        assert self._compaction is not None
        (state, written), self._writing = self._writing, None
        try:
            self._compaction.finish(state, written.result)
        except Exception as error:  # compaction is optional, so the scene continues with exact states
            if no_room(error):
                log.warning("scene %s: cannot compact states: %s", self._spec.folder.name, error)
                return False
            log.exception("scene %s: compaction is disabled until its worker restarts", self._spec.folder.name)
            self._failed = True
            return False
        return True

    def _head(self, history: History) -> FileHeader:
        bounds = Bounds(**self._rules.state_bounds.model_dump())
        return replace(compact_head(self._spec, history), bounds=bounds)
