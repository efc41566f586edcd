"""The comparison of an exported asset with the truth's poses, on motions that are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from export_cases import corner, moving

from scas4d_core.captures.ground_truth import TruePart
from scas4d_core.exports import export_sequence
from studies.exports.part_truth import AssetFigures, compare, read_asset, told_asset

pytest.importorskip("pygltflib", reason="the study reads with pygltflib")
FRAMES = 4


def poses(part: int, off: np.ndarray) -> np.ndarray:
    """[T, 4, 4] of a part in the user's world; its own axes lie elsewhere."""
    unit, origin = corner.WORLD.metres_per_unit, corner.WORLD.origin
    made = np.tile(np.eye(4), (FRAMES, 1, 1))
    for frame in range(FRAMES):
        turn, shift = moving.motion(part, frame)
        made[frame, :3, :3] = turn
        made[frame, :3, 3] = origin + shift / unit - turn @ origin
    return made @ off


def test_a_known_motion_has_no_error_and_another_has_its_own(tmp_path: Path) -> None:
    file = tmp_path / "a.glb"
    states = ((frame, frame / moving.RATE, moving.state(frame)) for frame in range(FRAMES))
    export_sequence(states, "glb-parts", file, world=corner.WORLD, parts=moving.LABELS)
    nodes = read_asset(file, np.arange(FRAMES) / moving.RATE)
    assert [node.name for node in nodes] == ["part 0", "part 1", "static"]
    off = np.eye(4)
    off[:3, 3] = [7, -2, 1]
    points = corner.wanted(moving.state(0)).means
    ids = np.where(moving.LABELS < 0, 9, moving.LABELS + 1)
    truth = [TruePart(k + 1, f"arm {k}", True, False, True, poses(k, off)) for k in (0, 1)]
    found = compare(nodes, truth, points, ids, list(range(FRAMES)), 100.0)
    for one, node in zip(found, ("part 0", "part 1"), strict=True):
        assert (one.node, one.share, one.covered) == (node, 1.0, True)
        assert one.degrees.max() < 0.1
        assert one.percent.max() < 0.01
    swapped = [
        TruePart(1, "arm", True, False, True, poses(1, off)),
        TruePart(5, "absent", True, False, True, poses(0, off)),
    ]
    wrong, absent = compare(nodes, swapped, points, ids, list(range(FRAMES)), 100.0)
    assert wrong.degrees.min() > 10
    assert wrong.percent.max() > 10
    assert not absent.covered
    text = told_asset([AssetFigures("by rule", 2, found), AssetFigures("by rule", 2, [wrong, absent])])
    assert text.count("reached") == text.count("missed") == 1
    assert "not found" in text
