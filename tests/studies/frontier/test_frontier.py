"""The study of accuracy against time on rows made of formulas, and its times."""

import json
import types
from dataclasses import replace

import numpy as np
import pytest
from made_frontier import made_psnr, made_row, made_seconds, made_study
from PIL import Image
from plates import write_capture
from typer.testing import CliRunner

from client.cli.scores import Store
from studies.commands import app
from studies.frontier import frontier, timing
from studies.frontier.frontier import AXES, DEFAULT, Variant, measure_variants, row_of, variants
from studies.frontier.page import chosen, equal_table, equal_words, write_page
from studies.frontier.tradeoff import (
    curve,
    equal_seconds,
    mean_points,
    psnr_at,
    read_points,
    undominated,
)
from studies.quality import first_frame


def test_every_setting_is_another_and_the_default_comes_first():
    everything = variants()
    assert everything[0] == DEFAULT
    settings = [json.dumps(v.record, sort_keys=True) for v in everything]
    assert len(set(settings)) == len(settings)
    assert {len(v.settings.update.clusters) for v in AXES["layers"]} == {1, 2, 4, 5}  # the default has three
    assert [v.settings.update.clusters[0] for v in AXES["clusters"]] == [16, 32, 48]
    assert [(v.settings.update.iterations, v.settings.update.views) for v in (DEFAULT, *AXES["views"])] == [
        (100, 1), (100, 2), (100, 4), (50, 2), (50, 4), (25, 4),
    ]  # fmt: skip
    assert [(v.settings.update.covariance, v.settings.update.deltas_start) for v in (DEFAULT, *AXES["covariance"])] == [
        ("entangled", 0.4), ("separate", 0.0),
    ]  # fmt: skip
    assert variants(["iterations"])[0] == DEFAULT
    with pytest.raises(ValueError, match="unknown axis 'layer'; choose from iterations"):
        variants(["layer"])


def test_only_what_is_missing_is_measured_the_cheapest_first(tmp_path, monkeypatch):
    (tmp_path / "robot").mkdir()
    store = Store(tmp_path / "out")
    there = Variant("scas4d 25", "scas4d", 25)
    store.put(made_row(there, "robot", 5))
    store.put(made_row(Variant("scas4d 10", "scas4d", 10), "robot", 3))  # other updates
    store.put(made_row(Variant("scas4d 50", "scas4d", 50), "robot", 5) | {"error": "killed"})
    asked = []
    monkeypatch.setattr(frontier, "run_jobs", lambda jobs, out, report: asked.extend(jobs) or [])
    lines: list[str] = []
    chosen = [variant for variant in AXES["iterations"] if variant.iterations <= 100]
    measure_variants([tmp_path / "robot"], chosen, tmp_path / "out", updates=5, report=lines.append)
    done = [(job.preset, job.settings.update.iterations, job.frames) for job in asked]
    assert done == [
        ("scas4d", 10, 6),
        ("dynamic3dgs", 10, 6),
        ("dynamic3dgs", 25, 6),
        ("scas4d", 50, 6),
        ("dynamic3dgs", 50, 6),
        ("scas4d", 100, 6),
        ("dynamic3dgs", 100, 6),
    ]
    assert lines == ["8 rows, 1 of them already measured"]


def test_a_varied_constant_is_another_row():
    (varied,) = AXES["max-scale"]
    assert varied.record["constants"] == {"scas4d_core.engines.plan.MAX_SCALE": 2.0}
    rows = [made_row(DEFAULT, "robot", 5), made_row(varied, "robot", 5)]
    assert (row_of(rows, DEFAULT, "robot", 5), row_of(rows, varied, "robot", 5)) == (rows[0], rows[1])


def test_dominated_is_what_is_no_faster_and_no_better(tmp_path):
    made_study(tmp_path, ("robot",), axes=("iterations", "clusters"))
    points = read_points(tmp_path, ["robot"], 5)
    best = undominated(points)
    assert [p.variant.label for p in best][:3] == ["dynamic3dgs 10", "scas4d 10", "scas4d 25"]
    for point in points:
        beaten = any(q.seconds <= point.seconds and q.psnr > point.psnr for q in points)
        assert beaten == (point not in best)


def test_at_equal_seconds_the_curve_is_read_between_its_points(tmp_path):
    made_study(tmp_path, ("robot", "wheel"), axes=("iterations",))
    points = read_points(tmp_path, ["robot", "wheel"], 5)
    ours = curve(points, "scas4d", "robot")
    at_75 = psnr_at(ours, np.sqrt(0.5 * 1.0))  # half way in the logarithm from 50 to 100 iterations
    assert at_75 == pytest.approx((made_psnr(Variant("", "scas4d", 50)) + made_psnr(DEFAULT)) / 2)
    assert psnr_at(ours, 0.05) is None
    slow = replace(ours[0], seconds=0.71, scores={**ours[0].scores, "psnr": 1.0})  # longer than a better one
    assert psnr_at([*ours, slow], np.sqrt(0.5 * 1.0)) == at_75
    compared = equal_seconds(points, ["robot", "wheel"])
    assert [one.iterations for one in compared] == [25, 50, 100, 200, 300] * 2
    at_100 = next(one for one in compared if one.iterations == 100)
    assert at_100.seconds == pytest.approx(0.5)  # as long as 50 of ours
    assert at_100.lead == pytest.approx(
        made_psnr(Variant("", "scas4d", 50)) - made_psnr(Variant("", "dynamic3dgs", 100))
    )
    name = "accuracy-equal-time"
    words = f"`scas4d` is ahead at 10<!-- {name}.ahead --> of 10<!-- {name}.budgets --> budgets;\n"
    assert equal_words(compared).startswith(f"{words}the smallest lead is +3.08<!-- {name}.smallest --> dB.")
    assert equal_table(compared).splitlines()[2].startswith("| robot | +")
    behind = [frontier_lead(one, -1.0) for one in compared[:1]] + compared[1:]
    assert f"ahead at 9<!-- {name}.ahead --> of 10" in equal_words(behind)
    assert f"the smallest lead is -1.00<!-- {name}.smallest --> dB" in equal_words(behind)


def frontier_lead(one, lead):
    return type(one)(one.capture, one.iterations, one.seconds, one.baseline_psnr + lead, one.baseline_psnr)


def test_seconds_are_those_measured_in_turns_where_there_are_any(tmp_path):
    made_study(tmp_path, ("robot", "wheel"), axes=("iterations",))
    entry = {"settings": DEFAULT.record, "seconds": 0.125, "stages": {"render": 0.1}}
    (tmp_path / "timing").mkdir()
    (tmp_path / "timing" / "robot.json").write_text(json.dumps({"settings": [entry]}))
    points = read_points(tmp_path, ["robot", "wheel"], 5)
    seconds = {p.capture: p.seconds for p in points if p.variant == DEFAULT}
    assert seconds == {"robot": 0.125, "wheel": made_seconds(DEFAULT)}
    (beside,) = [p for p in points if p.capture == "robot" and p.variant.label == "scas4d 300"]
    assert beside.seconds == pytest.approx(3 * 0.125)  # not timed itself: as its row is to the default's
    assert sum(beside.stages.values()) == pytest.approx(beside.seconds / 7)  # as its row's were of its row's seconds
    (mean,) = [p for p in mean_points(points, ["robot", "wheel"]) if p.variant == DEFAULT]
    assert mean.seconds == pytest.approx((0.125 + made_seconds(DEFAULT)) / 2)
    Store(tmp_path).put(made_row(DEFAULT, "wheel", 5, machine={"system": "Linux", "threads": 2}))
    (on_two,) = [p for p in read_points(tmp_path, ["wheel"], 5) if p.variant == DEFAULT]
    assert on_two.seconds == pytest.approx(7 * made_seconds(DEFAULT))  # two threads: the wall clock


def test_a_mean_needs_the_row_of_every_capture(tmp_path):
    store = made_study(tmp_path, ("robot",), axes=("iterations",))
    store.put(made_row(DEFAULT, "cloth", 5))
    (mean,) = mean_points(read_points(tmp_path, ["robot", "cloth"], 5), ["robot", "cloth"])
    assert mean.variant == DEFAULT
    assert mean.scores["parts_ari"] == pytest.approx(0.02 * made_psnr(DEFAULT))  # cloth has no parts


def test_the_choice_follows_its_rules(tmp_path):
    made_study(tmp_path, ("robot",), axes=("iterations",))
    found = chosen(read_points(tmp_path, ["robot"], 5))
    assert {purpose: point.variant.label for purpose, point in found.items()} == {
        "preview": "scas4d 50",  # loses 2.9 dB, 25 iterations lose 6.3
        "live show": "scas4d 200",  # gains 1.06 dB over 100 for twice the time, 300 nothing worth it
        "archive": "scas4d 200",  # 0.094 dB below the best
    }


def test_the_page_has_its_plots_and_tables(tmp_path):
    made_study(tmp_path / "study", ("robot", "cloth"))
    (tmp_path / "robot").mkdir()
    (tmp_path / "cloth").mkdir()
    page = tmp_path / "docs" / "page.md"
    command = ["frontier", str(tmp_path / "robot"), str(tmp_path / "cloth"), "--out", str(tmp_path / "study")]
    done = CliRunner().invoke(app, [*command, "--only", "page", "--page", str(page)])
    assert done.exit_code == 0, done.output
    text = page.read_text()
    for name in ("frontier", "captures", "stages"):
        assert f"(page/{name}.png)" in text
        with Image.open(tmp_path / "docs" / "page" / f"{name}.png") as picture:
            colours = np.asarray(picture.convert("RGB")).reshape(-1, 3)
            assert picture.width > 900
            drawn = (0x88, 0xCC, 0xEE) if name == "stages" else (0, 0x72, 0xB2)  # a stage, or the line of scas4d
            assert (colours == drawn).all(axis=1).sum() > 500
    assert "ahead at 10<!-- accuracy-equal-time.ahead --> of 10" in text
    assert "- Measured: 2026-01-02<!-- accuracy-iterations.date -->." in text
    for name in ("recommended", "equal-time", "iterations", "layers"):
        assert f"\n<!-- table: accuracy-{name} -->\n| " in text
    for words, label in (("Views per iteration", "50 iterations of 2 views"), ("Covariance", "separate covariance")):
        table = text.split(f"**{words}**\n\n")[1].split("\n\n")[0]
        assert f"| {label} |" in table
        assert "| scas4d 100 |" in table
    assert f"| scas4d 100 | 1.00 | 1.00 | {made_psnr(DEFAULT):.2f} |" in text
    refused = CliRunner().invoke(app, [*command, "--only", "plots"])
    assert refused.exit_code == 2
    assert "choose from rows, times, page" in " ".join(refused.output.replace("│", " ").split())


def test_a_page_of_nothing_says_what_to_do(tmp_path):
    with pytest.raises(ValueError, match="run scripts/bench frontier"):
        write_page(tmp_path, ["robot"], tmp_path / "page.md")


def test_settings_are_timed_in_turns_and_the_first_round_does_not_count(tmp_path, monkeypatch):
    capture = write_capture(tmp_path / "plates")  # of four frames
    took: list[str] = []
    now = [0.0]

    class Paced:
        def __init__(self, label, seconds):
            self.label, self.seconds = label, seconds
            self.history = types.SimpleNamespace(gaussians=lambda index: [0] * 7)

        def step(self, frame):
            took.append(f"{self.label}:{frame.index}")
            now[0] += self.seconds * (10 if frame.index == 1 else frame.index)
            return types.SimpleNamespace(seconds={"render": self.seconds})

    short, long = Variant("short", iterations=10), Variant("long", iterations=1000)
    paces = {short.settings.update.iterations: 1.0, long.settings.update.iterations: 3.0}
    monkeypatch.setattr(
        first_frame,
        "started",
        lambda capture, settings, out: Paced(settings.update.iterations, paces[settings.update.iterations]),
    )
    monkeypatch.setattr(timing.time, "perf_counter", lambda: now[0])
    row = timing.measure_times(capture, [short, long], tmp_path, report=lambda line: None)
    assert took == ["10:1", "1000:1", "1000:2", "10:2", "10:3"]
    assert row["rounds"] == 2  # the capture has no more frames
    assert row == timing.read_times(tmp_path, "plates")
    assert [entry["seconds"] for entry in row["settings"]] == [2.5, 6.0]
    assert timing.time_of(row, short)["label"] == "short"
    assert timing.time_of(row, DEFAULT) is None
    paces[short.settings.update.iterations] = 2.0  # a busier machine
    alone = timing.measure_times(capture, [short], tmp_path, report=lambda line: None)
    kept = alone["settings"][1]
    assert (kept["label"], kept["seconds"], kept["stages"]) == ("long", 12.0, {"render": 6.0})
    timing.measure_times(capture, [long], tmp_path, report=lambda line: None)
    assert len(timing.read_times(tmp_path, "plates")["settings"]) == 1  # nothing to compare by
