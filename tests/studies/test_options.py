"""Pages that studies write."""

from __future__ import annotations

from pathlib import Path

from studies.options import write_part


def test_only_the_part_between_the_markers_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "page.md"
    path.write_text("# Title\n\nbefore\n\n<!-- begin -->\nold\n<!-- end -->\n\nafter\n")
    write_part(path, "<!-- begin -->\nnew\n<!-- end -->")
    assert path.read_text() == "# Title\n\nbefore\n\n<!-- begin -->\nnew\n<!-- end -->\n\nafter\n"


def test_a_missing_part_is_appended(tmp_path: Path) -> None:
    path = tmp_path / "docs" / "page.md"
    write_part(path, "<!-- begin -->\nnew\n<!-- end -->")
    assert path.read_text() == "<!-- begin -->\nnew\n<!-- end -->\n"
