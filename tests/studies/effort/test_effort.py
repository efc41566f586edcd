"""How budgets and adaptive effort are told: within, over, reached and missed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from scas4d_core.captures import open_capture
from scas4d_core.settings import Settings
from studies.effort import effort
from studies.effort import report as effort_report
from studies.effort.effort import Kept, Turns
from studies.effort.page import effort_text
from studies.effort.sequences import as_it_is, back_and_forth, repeated

SAMPLE = Path(__file__).parents[3] / "samples" / "robot"


def test_what_is_within_is_measured_both_ways() -> None:
    kept = Kept(500.0, [0.5, 0.520, 0.530, 0.470, 0.400], [9] * 5, [0.01] * 5)
    row = kept.row()
    assert row["within"] == pytest.approx(2 / 5)  # 25 ms: 5% is more than one iteration
    assert row["not_over"] == pytest.approx(4 / 5)
    assert row["worst_off_ms"] == pytest.approx(30)
    assert Kept(100.0, [0.118], [1], [0.02]).row()["within"] == 1.0


def test_a_capture_goes_back_and_forth_and_time_goes_on() -> None:
    capture = open_capture(SAMPLE)
    count = capture.frame_count
    frames = list(back_and_forth(capture, 2 * count))
    assert [frame.index for frame in frames] == list(range(1, 2 * count + 1))
    assert np.diff([frame.time for frame in frames]).min() > 0
    name = capture.rig.names[0]
    np.testing.assert_array_equal(frames[0].images[name], frames[2 * count - 4].images[name])
    assert (frames[0].images[name] != frames[1].images[name]).any()


def test_repeats_are_said() -> None:
    capture = open_capture(SAMPLE)
    assert [shown.repeats for shown in repeated(capture, 3)] == [False, True] * 2 + [False, True, True, True]
    assert not any(shown.repeats for shown in as_it_is(capture, 3))


def test_two_settings_take_turns(tmp_path: Path) -> None:
    """Every frame of every seed is counted, and its repeats apart."""
    capture = open_capture(SAMPLE)
    effects = dict.fromkeys(("entering", "uncovered", "direction"), "off")  # what is so rough seems to call for them
    rough = {
        "static": {"iterations": 20},
        "update": {"skip_tolerance": 0.02, "reject_outliers": False},
        "effects": effects,
    }
    many, few = (
        Settings.model_validate({**rough, "update": {**rough["update"], "iterations": count}}) for count in (8, 2)
    )
    turns = Turns(("many", "few"))
    for _ in range(2):
        turns.take(capture, (many, few), repeated(capture, 2), tmp_path)
    row = turns.row()
    assert row["frames"] == 4
    assert row["iterations"] == [0, 1, 6]  # a repeat has none, the first update three times as many
    assert {name: len(values) for name, values in row["psnr_each"].items()} == {"many": 2, "few": 2}
    assert row["psnr"] == {name: values[0] for name, values in row["psnr_each"].items()}  # the same seed twice
    assert row["time_repeats"] < row["time"] < 1


def test_the_page_judges(tmp_path: Path) -> None:
    assert effort_text(tmp_path, ["robot"]) == ""
    folder = tmp_path / "effort"
    folder.mkdir()
    kept = [Kept(500.0, [0.5] * 20, [9] * 20, [0.01] * 20).row(), Kept(100.0, [0.2] * 20, [9] * 20, [0.01] * 20).row()]
    (folder / "robot-budgets.json").write_text(json.dumps({"capture": "robot", "budgets": kept}))

    def adaptive(time: float) -> None:
        psnr, each = {"scas4d": 30.0, "adaptive": 29.95}, {"scas4d": [29.5, 30.5], "adaptive": [29.95]}
        one = {"frames": 9, "psnr": psnr, "psnr_each": each, "time": time, "time_repeats": 0.05}
        rows = [{**one, "sequence": name} for name in ("as it is", "repeated", "slowed")]
        (folder / "robot-adaptive.json").write_text(json.dumps({"capture": "robot", "sequences": rows}))

    adaptive(0.5)
    text = effort_text(tmp_path, ["robot"])
    assert "| robot | 500 | 100% | 100% | +0.0 | +0.0 | 9 | reached |" in text
    assert "**missed** |" in text
    assert "(29.95 ± 0.00 : 30.00 ± 0.50)" in text
    assert "reached on every capture" in text
    adaptive(0.7)
    assert "**missed** on some captures" in effort_text(tmp_path, ["robot"])


def test_the_page_tells_what_reports_cost(tmp_path: Path) -> None:
    (tmp_path / "effort").mkdir()
    row = {"capture": "robot", "updates": 11, "share_worst": 0.03, "milliseconds": 9.0}
    for share, verdict in ((0.0123, "reached"), (0.0223, "**missed**")):
        (tmp_path / "effort" / "robot-report.json").write_text(json.dumps({**row, "share": share}))
        assert f"| {100 * share:.2f}% | 3.00% | {verdict} |" in effort_text(tmp_path, ["robot"])


def test_the_cost_of_reports_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few = effort.settings_of("scas4d")
    few = few.model_copy(
        update={
            "static": few.static.model_copy(update={"iterations": 20}),
            "update": few.update.model_copy(update={"iterations": 5}),
        }
    )
    monkeypatch.setattr(effort_report, "settings_of", lambda name: few)
    row = effort_report.measure_report(SAMPLE, tmp_path, updates=3, report=lambda line: None)
    assert row["updates"] == 2
    assert 0 < row["share"] <= row["share_worst"] < 1
    assert row["stages"]["report"] > 0
    assert (tmp_path / "effort" / "robot-report.json").exists()
