"""`scas4d export` from files, back again, and `scas4d evaluate --states`: the same states, whatever they came from."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from client.cli.evaluate import evaluate
from client.cli.evaluate_states import evaluate_states
from client.cli.main import app
from client.exports.export import export
from client.exports.sources import of_path
from scas4d_core.cameras import WorldFrame
from scas4d_core.compact import CompactReader
from scas4d_core.errors import InputError
from scas4d_core.exports import export_sequence
from scas4d_core.gaussians import Gaussians

FRAMES = 4
LABELS = np.array([0, 0, 1, 1, 1])
NOBODY = {"url": "http://127.0.0.1:1", "token": None}


def state(frame: int) -> Gaussians:
    """Five points of which three move; one is gone in frame 1, and one is born in frame 2."""
    rng = np.random.default_rng(3)
    made = Gaussians.of_points(rng.uniform(-0.3, 0.3, (5, 3)), 0.1, rng.random((5, 3)))
    shift = np.float32([[0.05 * frame, 0, 0]]) * (LABELS == 1)[:, None].astype(np.float32)
    made = made.replace(means=made.means + shift, foreground=(LABELS == 1).astype(np.float32))
    if frame == 1:
        return made.retire([0])
    return made if frame < 2 else made.concatenate(Gaussians.of_points([[0, 0.2, 0]], 0.1)).replace(ids=np.arange(6))


@pytest.fixture
def compact(tmp_path: Path) -> Path:
    file = tmp_path / "scene.s4d"
    coming = ((index, index / 30, state(index)) for index in range(FRAMES))
    world = WorldFrame(np.array([1.0, 2, 3]), metres_per_unit=0.5)
    export_sequence(coming, "s4d", file, world=world, parts=LABELS, frames_per_second=30, background=(0.25, 0.5, 0.75))
    return file


@pytest.mark.parametrize("format", ["usd", "glb"])
def test_what_went_out_comes_back_as_a_compact_file(compact: Path, tmp_path: Path, format: str) -> None:
    if format == "usd":
        pytest.importorskip("pxr", reason="pip install 'scas4d[exports]'")
    out = tmp_path / ("away.usdc" if format == "usd" else "away")
    export(str(compact), format, out, **NOBODY)
    export(str(out), "s4d", tmp_path / "back.s4d", rate=30, **NOBODY)
    with CompactReader(compact) as one, CompactReader(tmp_path / "back.s4d") as two:
        assert one.frames == two.frames == list(range(FRAMES))
        np.testing.assert_allclose(two.times, one.times, atol=1e-6)
        for index in one.frames:
            first, second = one.state(index), two.state(index)
            assert second.ids.tolist() == first.ids.tolist()
            assert second.present.tolist() == first.present.tolist()
            assert second.moving.tolist() == first.moving.tolist()
            means = [reader.head.world.to_user(each.means) for reader, each in ((one, first), (two, second))]
            np.testing.assert_allclose(*(each[first.present] for each in means), atol=0.01)
        if format == "usd":
            assert two.parts().tolist() == [*LABELS.tolist(), -1]


def test_a_range_of_a_compact_file_keeps_its_head(compact: Path, tmp_path: Path) -> None:
    export(str(compact), "s4d", tmp_path / "cut.s4d", "1:2", **NOBODY)
    with CompactReader(tmp_path / "cut.s4d") as reader:
        assert reader.frames == [1, 2]
        assert reader.head.background == (0.25, 0.5, 0.75)
        assert reader.head.world.metres_per_unit == 0.5


def test_a_folder_with_frames_of_a_longer_export_is_refused(compact: Path, tmp_path: Path) -> None:
    out = tmp_path / "frames"
    export(str(compact), "ply", out, **NOBODY)
    (out / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"contains 2 files .* frame_000002.ply"):
        export(str(compact), "ply", out, "0:1", **NOBODY)
    assert len(list(out.glob("frame_*.ply"))) == FRAMES
    export(str(compact), "ply", out, **NOBODY)  # the same again
    export(str(compact), "splat", out, "0:1", **NOBODY)  # other files are no frames of it
    assert (out / "notes.txt").exists()


def test_a_source_without_ids_or_parts_is_refused_in_words(compact: Path, tmp_path: Path) -> None:
    export(str(compact), "splat", tmp_path / "splats", **NOBODY)
    with pytest.raises(InputError, match="no ids"):
        export(str(tmp_path / "splats"), "s4d", None, **NOBODY)
    export(str(compact), "glb", tmp_path / "frames", **NOBODY)
    with pytest.raises(InputError, match="has no parts"):
        export(str(tmp_path / "frames"), "glb-parts", None, **NOBODY)
    with pytest.raises(
        InputError, match="has no cameras, but format 'tapvid-mv' requires them; use a source with a rig"
    ):
        export(str(tmp_path / "frames"), "tapvid-mv", None, **NOBODY)
    with pytest.raises(InputError, match="id cannot be used with format 'ply'; omit --id, or use tracks or tapvid-mv"):
        export(str(compact), "ply", None, ids=[1], **NOBODY)
    said = CliRunner().invoke(app, ["export", str(tmp_path / "splats"), "--format", "usd"])
    assert said.exit_code != 0


def test_states_of_any_source_have_the_same_scores(compact: Path, capture_folder: Path, tmp_path: Path) -> None:
    export(str(compact), "glb", tmp_path / "frames.zip", **NOBODY)
    rows, said = [], []
    for source in (compact, tmp_path / "frames.zip"):
        out = tmp_path / f"scores-{source.stem}"
        rows.append(evaluate_states(source, capture_folder, out, frames=3, report=said.append))
        assert (out / "table.md").read_text().strip() == said[-1]
        (folder,) = (out / "pictures").iterdir()
        assert sorted(path.name for path in folder.iterdir()) == [f"frame000{k}_camera2.png" for k in range(3)]
        (lines,) = (out / "frames").iterdir()
        assert [json.loads(line)["index"] for line in lines.read_text().splitlines()] == [0, 1, 2]
    one, two = rows
    assert (one["updates"], one["gaussians"], one["preset"]) == (2, 6, "scene.s4d")
    assert one["psnr"] > 0
    assert "iterations" not in one
    background = of_path(tmp_path / "frames.zip").of.head.background
    assert background == (0, 0, 0)  # glTF has none: the scores differ by it
    assert two["psnr"] != one["psnr"]
    half = evaluate_states(compact, capture_folder, tmp_path / "half", frames=3, image_scale=0.5, report=said.append)
    (image,) = (tmp_path / "half" / "pictures").rglob("frame0000_camera2.png")
    full = tmp_path / f"scores-{compact.stem}" / "pictures" / one["key"] / "frame0000_camera2.png"
    with Image.open(image) as small, Image.open(full) as large:
        assert small.height < large.height
    assert half["psnr"] != one["psnr"]
    (tmp_path / "unscored").mkdir()
    (tmp_path / "unscored" / "states.s4d").write_bytes(compact.read_bytes())
    with pytest.raises(
        InputError, match=r"contains a reconstruction, but no scores; use --states .*unscored and another"
    ):
        evaluate(capture_folder, tmp_path / "unscored", changes={})
    refused = CliRunner().invoke(
        app, ["evaluate", str(capture_folder), "--states", str(compact), "--set", "update.iterations=5"]
    )
    assert refused.exit_code != 0
    with pytest.raises(InputError, match="does not exist"):
        evaluate_states(tmp_path / "none.s4d", capture_folder, tmp_path / "x", report=said.append)
