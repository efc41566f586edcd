"""Rows of a study: each is measured once and stored in the study's folder, and all are written as one table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from client.cli.evaluate import Report
from client.cli.scores import Column, Row, digest, markdown, read_row, write_row
from studies.machine import core_version, machine


def kept_row(path: Path, measured: Callable[[], Row], *, again: bool = False) -> Row:
    """Returns the stored row; measures and stores it first if it is missing or ``again`` is true."""
    row = None if again else read_row(path)
    if row is None:
        row = measured()
        write_row(path, row)
    return row


class RowStudy:
    """The rows of a study, stored as ``out/<name>/<label>-<digest>.json`` and written to ``out/<name>.md``.

    Args:
        out: study folder. A second study with the same folder resumes the first.
        name: name of the study.
        columns: columns of its table.
        again: whether to measure rows again that are stored.
        report: callback that prints progress messages and the table.

    Attributes:
        rows: the rows so far.
    """

    def __init__(
        self, out: Path, name: str, columns: Sequence[Column], *, again: bool = False, report: Report = print
    ) -> None:
        self.rows: list[Row] = []
        self._out, self._name, self._columns = out, name, columns
        self._again, self._report = again, report

    def add(self, label: str, given: Sequence[Any], measured: Callable[[], Row], words: Callable[[Row], str]) -> Row:
        """Adds a row, measuring it if it is not stored, and returns it.

        Args:
            label: first part of its file name.
            given: JSON values on which the row depends.
            measured: function that measures the row.
            words: function that returns the progress message of the row.
        """
        path = self._out / self._name / f"{label}-{digest(*given)}.json"

        def whole() -> Row:
            return {"key": path.stem, **measured(), "core": core_version(), "machine": machine()}

        self.rows.append(kept_row(path, whole, again=self._again))
        self._report(words(self.rows[-1]))
        return self.rows[-1]

    def finish(self) -> list[Row]:
        """Writes and prints the table, and returns the rows."""
        self.write(markdown(self.rows, self._columns))
        return self.rows

    def write(self, text: str) -> None:
        """Writes a text as the study's page and prints it."""
        self._out.mkdir(parents=True, exist_ok=True)
        (self._out / f"{self._name}.md").write_text(text + "\n")
        self._report(text)
