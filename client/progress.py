"""Progress display: bars in a terminal, otherwise a line every few seconds."""

from __future__ import annotations

import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

console = Console()

LINE_S = 10.0
"""Default interval in seconds between lines for the same stage if the output is not a terminal."""


class Bars:
    """Progress bars, one per stage, updated by calling the object with (stage, done, total).

    Args:
        to: console to write to; None for the default console.
        every: interval in seconds between lines for the same stage if the output is not a terminal.
    """

    def __init__(self, to: Console | None = None, every: float = LINE_S) -> None:
        self._console = console if to is None else to
        self._every = every
        self._progress = Progress(
            TextColumn("{task.description:<28}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=self._console,
        )
        self._tasks: dict[str, TaskID] = {}
        self._began: dict[str, float] = {}
        self._said = 0.0

    def __enter__(self) -> Bars:
        if self._console.is_terminal:
            self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._console.is_terminal:
            self._progress.stop()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Updates the bar of a stage and completes the bars of earlier stages."""
        if self._console.is_terminal:
            self._move(stage, done, total)
        else:
            self._say(stage, done, total)

    def _move(self, stage: str, done: int, total: int) -> None:
        if stage not in self._tasks:
            self._tasks[stage] = self._progress.add_task(stage, total=total)
        for task in self._progress.tasks[: list(self._tasks).index(stage)]:
            if task.completed != task.total:
                self._progress.update(task.id, completed=task.total)
        self._progress.update(self._tasks[stage], completed=done, total=total)

    def _say(self, stage: str, done: int, total: int) -> None:
        now = time.monotonic()
        new = stage not in self._began
        began = self._began.setdefault(stage, now)
        if not new and now - self._said < self._every:
            return
        self._said = now
        counted = f" {done} of {total}" if total > 1 else ""
        seconds = "" if new else f", {now - began:.0f} s"
        self._console.print(f"{stage}{counted}{seconds}", highlight=False, soft_wrap=True)
