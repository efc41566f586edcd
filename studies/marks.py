"""Marks figures in pages that studies write, for ``scripts/figures.py``, which records them."""

from __future__ import annotations


def marked(text: str, name: str) -> str:
    """Returns a number or day, followed by the name of its record and value, such as ``kernels-cost.gaussians``.

    >>> marked("35.7", "robot.psnr"), marked("+1.2", "robot.gain"), marked("–", "robot.psnr")
    ('35.7<!-- robot.psnr -->', '+1.2<!-- robot.gain -->', '–')
    """
    return f"{text}<!-- {name} -->" if text[-1:].isdigit() else text


def marked_days(days: str, record: str) -> str:
    """Returns a day or a range of days from ``studies.machine.provenance``, marked as those of a record.

    >>> marked_days("2026-01-02", "robot")
    '2026-01-02<!-- robot.date -->'
    >>> marked_days("2026-01-02 to 2026-01-03", "robot")
    '2026-01-02<!-- robot.begun --> to 2026-01-03<!-- robot.date -->'
    """
    first, to, last = days.rpartition(" to ")
    return f"{marked(first, f'{record}.begun')}{to}{marked(last, f'{record}.date')}"


def marked_table(table: str, name: str) -> str:
    """Returns a Markdown table after the line that names its record.

    >>> print(marked_table("| a |\\n|---|\\n| 1 |", "robot"))
    <!-- table: robot -->
    | a |
    |---|
    | 1 |
    """
    return f"<!-- table: {name} -->\n{table}"
