"""Figures of the pages come from docs/figures.json, with their command, date and machine."""

from __future__ import annotations

import importlib.util
import json
import re
from pathlib import Path

import pytest
from source_tree import ROOT

SPEC = importlib.util.spec_from_file_location("figures", ROOT / "scripts" / "figures.py")
assert SPEC is not None
assert SPEC.loader is not None
figures = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(figures)

RECORDS = {"robot": {"command": "c", "date": "2026-12-01", "machine": "m", "values": {"psnr": 35.748, "count": 21821}}}


def test_figures_of_the_pages_are_current() -> None:
    records = figures.load()
    for page in figures.PAGES:
        assert figures.with_figures(page.read_text(), records) == page.read_text(), "run scripts/figures.py"


def test_the_readme_has_no_other_numbers_with_units() -> None:
    assert figures.unrecorded((ROOT / "README.md").read_text()) == []


@pytest.mark.parametrize("page", figures.PAGES, ids=lambda page: page.name)
def test_sections_with_measurements_have_no_other_numbers_with_units(page: Path) -> None:
    assert figures.unrecorded_in_sections(page.read_text()) == []


def test_every_record_names_command_date_and_machine_and_is_used() -> None:
    used = set()
    for page in figures.PAGES:
        used |= {name.partition(".")[0] for _, name in figures.FIGURE.findall(page.read_text())}
        used |= {name for name, _ in figures.TABLE.findall(page.read_text())}
    records = figures.load()
    assert set(records) == used
    for name, record in records.items():
        assert record["command"], name
        assert record["machine"], name
        assert re.fullmatch(r"\d{4}-\d{2}-\d{2}", record["date"]), name


@pytest.mark.parametrize(
    ("text", "written"),
    [
        ("1.0<!-- robot.psnr --> dB", "35.7<!-- robot.psnr --> dB"),
        ("| 0.00<!-- robot.psnr -->|", "| 35.75<!-- robot.psnr -->|"),
        ("1,000<!-- robot.count --> Gaussians (2025-01-01<!-- robot.date -->)",
         "21,821<!-- robot.count --> Gaussians (2026-12-01<!-- robot.date -->)"),
    ],
)  # fmt: skip
def test_a_figure_has_the_decimals_of_the_text(text: str, written: str) -> None:
    assert figures.with_figures(text, RECORDS) == written


def test_an_unknown_figure_is_an_error() -> None:
    with pytest.raises(KeyError, match="ssim"):
        figures.with_figures("1<!-- robot.ssim -->", RECORDS)


@pytest.mark.parametrize("text", ["35.7 dB", "about two minutes", "1.5 s", "a 40% gain", "200 MB", "30 frames/s"])
def test_numbers_with_units_must_be_recorded(text: str) -> None:
    assert len(figures.unrecorded(text)) == 1
    assert figures.unrecorded(f"`{text}`\n```\n{text}\n```\n") == []


def test_what_is_no_measurement_needs_no_record() -> None:
    assert (
        figures.unrecorded(
            "Python 3.11, 27 cameras 640×360, port 8000, two commands, the two ones, 1.0<!-- robot.psnr --> dB"
        )
        == []
    )


def test_tables_of_the_pages_are_replaced() -> None:
    records = {"speed": {"table": ["| a |", "|---|", "| 2 |"]}}
    page = "# Speed\n\n<!-- table: speed -->\n| a |\n|---|\n| 1 |\n| 1 |\n\nText.\n\n| b |\n|---|\n"
    assert figures.with_figures(page, records) == page.replace("| 1 |\n| 1 |", "| 2 |")
    with pytest.raises(KeyError, match="speed"):
        figures.with_figures(page, {})


def test_a_table_of_a_study_is_found_by_its_number() -> None:
    assert figures.tables_of("| a |\n|---|\n\ntext | no\n\n| b |\n|---|\n| 1 |\n") == [
        ["| a |", "|---|"], ["| b |", "|---|", "| 1 |"]
    ]  # fmt: skip


def test_figures_of_a_page_that_a_study_wrote_are_recorded() -> None:
    page = "On 2026-11-01<!-- speed.date -->: 1,200.5<!-- speed.rate -->\n\n<!-- table: times -->\n| 1 |\n|---|\n"
    records = figures.record_page(page, "scripts/bench speed")
    assert records["speed"].pop("machine")
    assert records["speed"] == {
        "command": "scripts/bench speed", "date": "2026-11-01", "values": {"rate": 1200.5}
    }  # fmt: skip
    assert records["times"]["table"] == ["| 1 |", "|---|"]
    assert records["times"]["date"] == "2026-11-01"
    assert figures.with_figures(page, records) == page


def test_only_figures_that_a_study_changed_are_recorded() -> None:
    page = "35.7<!-- robot.psnr -->, 2<!-- speed.rate -->, 2025-01-01<!-- days.begun -->\n\n<!-- table: a -->\n| 1 |\n"
    measured = figures.record_page(page, "scripts/bench speed")
    assert measured["days"]["values"] == {"begun": "2025-01-01"}
    known = RECORDS | {"speed": {"values": {"rate": 1}}, "a": {"table": ["| 1 |"]}}
    assert set(figures.changed_records(page, measured, known)) == {"speed", "days"}
    assert set(figures.changed_records(page, measured, known | measured)) == set()
    assert set(figures.changed_records(page, measured, {})) == {"robot", "speed", "days", "a"}


@pytest.mark.parametrize(
    ("section", "found"),
    [
        ("Takes 3 s, 4<!-- a.b --> s, `5 s` or 6%.", ["3 s", "6%"]),
        ("<!-- table: a -->\n| 1 s |\n\nAt most 2 s.", ["2 s"]),
        ("At most 2 s.", []),
        ("Measured on 2026-12-01.", ["2026-12-01"]),
        ("Measured on 2026-12-01<!-- a.date -->.", []),
    ],
)
def test_measured_sections_are_those_with_figures_or_dates(section: str, found: list[str]) -> None:
    page = f"# Limits\n\nAt most 9 s.\n\n## Speed\n\n{section}\n\n## Others\n\nAt most 9 s.\n"
    assert figures.unrecorded_in_sections(page) == found


def row_file(folder: Path, name: str, **changes: object) -> Path:
    row = {"capture": "robot", "measured": "2026-12-01T03:00:00+00:00", "preset": "scas4d", "changes": [],
           "psnr": 35.74812, "parts_ari": None}  # fmt: skip
    (folder / name).write_text(json.dumps(row | changes))
    return folder / name


def test_rows_are_recorded(tmp_path: Path) -> None:
    records = dict(figures.record_rows([row_file(tmp_path, "a"), row_file(tmp_path, "b", capture="cloth", psnr=30)]))
    assert set(records) == {"robot", "cloth"}
    assert records["robot"].pop("machine")
    assert records["robot"] == {
        "command": "scas4d evaluate CAPTURES/robot", "date": "2026-12-01", "values": {"psnr": 35.7481}
    }  # fmt: skip


@pytest.mark.parametrize("changes", [{"preset": "fast"}, {"changes": ["update.iterations=9"]}, {}])
def test_rows_of_other_settings_and_second_rows_are_refused(tmp_path: Path, changes: dict[str, object]) -> None:
    paths = [row_file(tmp_path, "a"), row_file(tmp_path, "b", **changes)]
    with pytest.raises(ValueError, match="b: "):
        list(figures.record_rows(paths))


def test_times_of_commands_are_recorded() -> None:
    ran: list[list[str]] = []
    record = figures.record_time(["scripts/test", "--fast"], ran.append)
    assert ran == [["scripts/test", "--fast"]]
    assert record["command"] == "scripts/test --fast"
    assert set(record["values"]) == {"seconds", "minutes"}


@pytest.mark.parametrize("text", ["**1.0<!-- robot.psnr -->**", "(1.0<!-- robot.psnr -->)"])
def test_only_the_number_is_replaced(text: str) -> None:
    assert figures.with_figures(text, RECORDS) == text.replace("1.0", "35.7")
