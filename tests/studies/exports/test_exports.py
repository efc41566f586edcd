"""The study of exports: every format of splats, read back and rendered, a little of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from client.cli.reconstruct import reconstruct
from client.importers.open_source import open_source
from studies.exports.exports import READERS, measure, sheet, summarize
from studies.exports.part_truth import measure_asset

for package in ("gsply", "pxr", "pygltflib"):
    pytest.importorskip(package, reason=f"the study reads with {package}")

SAMPLE = Path(__file__).parents[3] / "samples" / "robot"
CHANGES = {
    "scene": {"image_scale": 0.25},
    "static": {"iterations": 20, "max_gaussians": 500},
    "update": {"iterations": 4},
}


def test_each_format_shows_the_state(tmp_path: Path) -> None:
    reconstruct(open_source(SAMPLE), tmp_path, frames=2, preset="scas4d", changes=CHANGES)
    found = measure(SAMPLE, tmp_path / "states")
    assert [one.format for one in found] == list(READERS)
    least = {"ply": 60, "glb": 60, "usd": 60, "glb-parts": 20}
    assert all(one.psnr > least.get(one.format, 38) for one in found), [(one.format, one.psnr) for one in found]
    assert sheet(found, columns=2).width > 2 * found[0].picture.shape[1]
    by_rule, as_many = measure_asset(SAMPLE, tmp_path / "states")
    assert as_many.nodes == len(as_many.parts) == len(by_rule.parts) == 6
    assert summarize(found).count("|\n") >= len(READERS)
