"""Bars: what a terminal shows at the end of a stage, and the lines where there is no terminal."""

from __future__ import annotations

import io

from rich.console import Console

from client.progress import Bars


def test_a_stage_that_is_over_has_a_full_bar_whatever_came_first():
    shown = io.StringIO()
    with Bars(Console(file=shown, force_terminal=True, width=100, _environ={"TERM": "xterm"})) as bars:
        bars("starting", 0, 1)
        bars("fitting frame 0", 2900, 3000)
        bars("frames", 1, 4)
        bars("fitting frame 0", 2950, 3000)  # a late word
        bars("frames", 4, 4)
    last = shown.getvalue().rsplit("starting", 1)[1]
    assert "1/1" in last
    assert "3000/3000" in last
    assert "4/4" in last


def test_elsewhere_a_line_a_stage_and_one_now_and_then():
    shown = io.StringIO()
    with Bars(Console(file=shown), every=3600) as bars:
        for done in range(5):
            bars("fitting frame 0", done, 5)
        bars("kernels", 0, 1)
    assert shown.getvalue() == "fitting frame 0 0 of 5\nkernels\n"
    shown = io.StringIO()
    with Bars(Console(file=shown), every=0) as bars:
        bars("frames", 0, 2)
        bars("frames", 1, 2)
    assert shown.getvalue() == "frames 0 of 2\nframes 1 of 2, 0 s\n"
