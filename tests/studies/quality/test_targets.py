"""The table of targets on rows made here: what is reached, missed, not measured, and over which updates."""

import json

import pytest
from typer.testing import CliRunner

from client.cli.evaluate import Job
from client.cli.scores import Store
from studies.commands import app
from studies.quality import runs
from studies.quality.runs import CAPTURES, RUNS, measure_runs, measured_runs
from studies.quality.targets import (
    KERNELS,
    TARGETS,
    Target,
    compare,
    count_words,
    page,
    read_study,
    target_table,
)


def made_row(name: str, capture: str, psnr: list[float], **more: object) -> dict:
    """A row as the study leaves it, with a PSNR for every frame."""
    run = RUNS[name]
    updates = psnr[1:]
    return {
        "key": f"{capture}-{name}-{len(psnr)}",
        "variant": name,
        "capture": capture,
        "preset": run.preset,
        "iterations": 100,
        "settings": run.settings().model_dump(mode="json"),
        "given": {"frames": len(psnr), "masks": run.masks, "points": run.points},
        "capture_frames": 5,
        "updates": len(updates),
        "psnr_first": psnr[0],
        "psnr_by_frame": psnr,
        "psnr": sum(updates) / max(len(updates), 1),
        "measured": "2026-01-02T03:04:05+00:00",
        "core": "0123abcd",
        "machine": {"processor": "A Processor", "cores": 2, "threads": 1, "memory_gb": 8.0, "system": "Linux"},
        "seconds_stages": {"render": 1.0, "cascade": 2.0},
        "seconds_update": 3.5,
        **more,
    }


def the_one(verdicts, what: str, capture: str | None = None):
    (found,) = [v for v in verdicts if v.target.what == what and capture in (None, v.capture)]
    return found


def test_a_bar_is_compared_as_measured_not_as_rounded():
    rows = {("scas4d", "robot"): made_row("scas4d", "robot", [36.0, 30.999, 30.9999])}
    frame_0, updates = compare(rows, [TARGETS[0], Target("updates", "scas4d", "psnr", ("robot",), "≥", 31.0)])
    assert frame_0.reached is True
    assert frame_0.updates == "frame 0"
    assert updates.reached is False
    assert updates.updates == "2 of 4"
    text = target_table([frame_0, updates]).splitlines()
    assert text[2] == "| frame 0 PSNR | robot | ≥ 36.00 dB | 36.00 | reached | frame 0 |"
    assert text[3] == "| updates | robot | ≥ 31.00 dB | 31.00 | **missed** | 2 of 4 |"


def test_a_difference_is_over_the_updates_that_both_have():
    target = Target("ahead", "scas4d", "psnr", ("robot",), ">", 0.0, over="dynamic3dgs")
    rows = {
        ("scas4d", "robot"): made_row("scas4d", "robot", [36.0, 30.0, 31.0, 20.0, 20.0]),
        ("dynamic3dgs", "robot"): made_row("dynamic3dgs", "robot", [36.0, 29.0, 29.0]),
    }
    (verdict,) = compare(rows, [target])
    assert verdict.value == pytest.approx(1.5)  # over all updates it would be behind
    assert verdict.reached is True
    assert verdict.updates == "2 of 4"
    assert "| +1.50 (30.50 vs. 29.00) | reached | 2 of 4 |" in target_table([verdict])


def test_a_mean_needs_every_capture_and_weighs_them_alike():
    target = Target("mean", "scas4d", "psnr", ("robot", "wheel"), "≥", 30.5, mean=True)
    rows = {("scas4d", "robot"): made_row("scas4d", "robot", [36.0, 33.0, 33.0, 33.0])}
    assert compare(rows, [target])[0].word == "not measured"
    rows["scas4d", "wheel"] = made_row("scas4d", "wheel", [34.0, 28.0])
    (verdict,) = compare(rows, [target])
    assert verdict.capture == "mean of robot, wheel"
    assert verdict.value == pytest.approx(30.5)
    assert verdict.reached is True
    assert verdict.updates == "3 of 4, 1 of 4"


def test_losses_are_against_frame_0_of_the_same_row():
    row = made_row("scas4d", "basketball", [29.0, 28.9, 28.2, 28.6], psnr_changed=21.5)
    verdicts = compare({("scas4d", "basketball"): row})
    mean = the_one(verdicts, "mean PSNR loss relative to frame 0")
    worst = the_one(verdicts, "worst PSNR loss relative to frame 0")
    assert mean.value == pytest.approx(29.0 - (28.9 + 28.2 + 28.6) / 3)
    assert worst.value == pytest.approx(0.8)
    assert mean.reached
    assert worst.reached
    reported = the_one(verdicts, "PSNR over pixels changed since frame 0")
    assert (reported.value, reported.reached, reported.word) == (21.5, None, "")


def test_frame_0_alone_says_nothing_of_updates():
    rows = {("scas4d", "robot"): made_row("scas4d", "robot", [36.5])}
    verdicts = compare(rows)
    assert the_one(verdicts, "frame 0 PSNR", "robot").reached is True
    assert the_one(verdicts, "update PSNR", "robot").word == "not measured"
    assert the_one(verdicts, "3D tracks, median error", "robot").word == "not measured"


def test_every_bar_names_a_run_that_is_made():
    for target in TARGETS:
        for name in filter(None, (target.run, target.over)):
            assert name == KERNELS or set(target.captures) <= set(RUNS[name].captures)
        assert (target.threshold is None) == (target.sense == "")


def test_only_rows_of_todays_settings_count_and_the_longest_of_them(tmp_path):
    store = Store(tmp_path)
    store.put(made_row("scas4d", "robot", [36.0, 30.0]))
    store.put(made_row("scas4d", "robot", [36.0, 31.0, 31.0]))
    other = made_row("scas4d", "robot", [36.0, 40.0, 40.0, 40.0])
    other["settings"]["update"]["warm_start"] = 0.123
    store.put(other)
    unmasked = made_row("scas4d", "wheel", [36.0, 40.0])
    unmasked["given"]["masks"] = False
    store.put(unmasked)
    store.put(made_row("scas4d", "cloth", [36.0, 40.0]) | {"error": "out of memory"})
    first_alone = made_row("robot-unaided", "robot", [35.5])
    first_alone["settings"]["update"]["warm_start"] = 0.123
    store.put(first_alone)
    found = measured_runs(store)
    assert {place: row["psnr"] for place, row in found.items()} == {
        ("scas4d", "robot"): 31.0,
        ("robot-unaided", "robot"): 0,
    }


def test_runs_differ_in_what_they_say_they_do(tmp_path):
    jobs = {name: run.job(tmp_path / "robot") for name, run in RUNS.items() if "robot" in run.captures}
    assert len({job.key for job in jobs.values()}) == len(jobs)
    assert jobs["dynamic3dgs"].preset == "dynamic3dgs"
    assert jobs["robot-unaided"].frames == 1
    assert not jobs["robot-unaided"].points
    assert RUNS["scas4d"].job(tmp_path / "robot", 3).frames == 3
    assert RUNS["robot-unaided"].job(tmp_path / "robot", 3).frames == 1


def test_the_runs_are_measured_where_captures_are(tmp_path, monkeypatch):
    (tmp_path / "robot").mkdir()
    asked: list[Job] = []
    monkeypatch.setattr(runs, "run_jobs", lambda jobs, out, **options: asked.extend(jobs) or [])
    lines: list[str] = []
    measure_runs(tmp_path, tmp_path / "out", ["scas4d", "dynamic3dgs"], frames=4, report=lines.append)
    assert [(job.capture.name, job.preset, job.frames) for job in asked] == [
        ("robot", "scas4d", 4),
        ("robot", "dynamic3dgs", 4),
    ]
    assert len(lines) == len(CAPTURES) - 1
    with pytest.raises(ValueError, match="unknown run 'scas'"):
        measure_runs(tmp_path, tmp_path / "out", ["scas"])
    with pytest.raises(ValueError, match="contains none of the requested captures"):
        measure_runs(tmp_path / "robot", tmp_path / "out", report=lines.append)


def test_the_command_writes_the_page(tmp_path):
    study = tmp_path / "study"
    Store(study).put(made_row("scas4d", "robot", [36.0, 31.5, 31.25], gaussians=20_000))
    kernels = {
        "capture": "robot",
        "ratio_rasterizer": 1.5,
        "ratio_rasterizer_cloud": 2.5,
        "ratio_update": 3.25,
        "peak_mb": 900.0,
    }
    (study / "kernels.json").write_text(json.dumps(kernels))
    done = CliRunner().invoke(app, ["table", str(study), "--out", str(tmp_path / "docs" / "quality.md")])
    assert done.exit_code == 0, done.output
    verdicts = compare(read_study(study))
    assert sum(v.reached is True for v in verdicts) == 5  # frame 0, Gaussians, updates, rasterizer, memory
    assert sum(v.reached is False for v in verdicts) == 2
    assert done.output == target_table(verdicts) + "\n\n" + count_words(verdicts) + ".\n"
    text = (tmp_path / "docs" / "quality.md").read_text()
    assert text == page(read_study(study))
    assert "- Measured: 2026-01-02<!-- quality-targets.date -->." in text
    assert "- Machine: `A Processor, 2 cores, 1 thread used, 8 GB RAM, Linux`." in text
    assert "5<!-- quality-targets.reached --> are reached, 2<!-- quality-targets.missed --> missed" in text
    assert "\n<!-- table: quality-targets -->\n| metric |" in text
    assert "\n<!-- table: quality-rows -->\n| capture |" in text
    assert "| update PSNR | robot | ≥ 31.00 dB | 31.38 | reached | 2 of 4 |" in text
    assert "| update-to-rasterizer ratio | robot | ≤ 3.00 × | 3.25 | **missed** | – |" in text
    assert "| robot | scas4d | 100 | – | 20,000 | 2 | 36.00 | 31.38 |" in text


def test_the_table_of_no_study_says_what_to_do(tmp_path):
    done = CliRunner().invoke(app, ["table", str(tmp_path / "none")])
    assert done.exit_code == 2
    assert "measure first" in done.output
