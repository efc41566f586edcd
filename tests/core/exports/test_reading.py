"""Exports read back as states: what went out comes in again, with ids, births and what is gone; the rest is refused."""

from __future__ import annotations

import json
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
from export_cases import corner, moving
from export_cases.corner import Found

from scas4d_core.compact import CompactReader
from scas4d_core.errors import InputError
from scas4d_core.exports import FORMATS, export_sequence
from scas4d_core.exports.reading import ExportedStates, open_export, sources
from scas4d_core.gaussians import Gaussians, quaternions_to_matrices

LATER = Gaussians.of_points([[0.5, -1.2, 2.2]], 0.05, [0.2, 0.7, 0.1])
FIRST = 5
RATE = moving.RATE


def sequence(changes: bool) -> list[Gaussians]:
    """Four frames: rows 1 and 2 are gone in the second, and one is born in the third."""
    states = [moving.state(frame) for frame in range(4)]
    if changes:
        states[1] = states[1].retire([1, 2])
        born = LATER.replace(opacities=np.float32([0.4]), foreground=np.float32([0]))
        for frame in (2, 3):
            joined = states[frame].concatenate(born)
            states[frame] = joined.replace(ids=np.append(states[frame].ids, 97))
    return states


def written(path: Path, format: str, states: list[Gaussians]) -> Path:
    coming = ((FIRST + k, 2 + k / RATE, state) for k, state in enumerate(states))
    export_sequence(
        coming, format, path, world=corner.WORLD, rig=corner.rig(), parts=moving.LABELS, frames_per_second=RATE
    )
    return path


def found(state: Gaussians, read: ExportedStates) -> Found:
    """In the user's world."""
    unit = read.head.world.metres_per_unit
    factors = state.factors.astype(np.float64) / unit
    return Found(
        read.head.world.to_user(state.means), factors @ factors.transpose(0, 2, 1), state.colours, state.own_opacities
    )


def assert_states(read: ExportedStates, states: list[Gaussians], metres: bool = False) -> None:
    assert list(read.frames) == [FIRST + k for k in range(len(states))]
    for (index, _, back), truth, frame in zip(read.states(), states, range(len(states)), strict=True):
        assert index == FIRST + frame
        assert sorted(back.ids.tolist()) == sorted(truth.ids.tolist())
        order = [back.ids.tolist().index(id) for id in truth.ids.tolist()]
        back = back.rows(order)
        there = truth.present
        np.testing.assert_array_equal(back.present, there)
        limits = {"means": 1e-4, "covariances": 1e-5, "colours": 1e-6, "opacities": 1e-6}
        wanted = corner.wanted(truth).rows(there)
        corner.assert_same(found(back, read).rows(there), wanted, **limits)
        np.testing.assert_array_equal(back.foreground > 0.5, truth.foreground > 0.5)
        if frame < 2:  # a turn of the axes by less than 45 degrees is told by them
            turns = [quaternions_to_matrices(each.rotations[there].astype(float)) for each in (back, truth)]
            assert np.abs(turns[0] - turns[1])[moving.LABELS[there[:10]] == 0].max() < 0.05


@pytest.mark.parametrize("out", ["folder", "a.zip"])
def test_numbered_glb_comes_back(tmp_path, out):
    states = sequence(changes=True)
    read = open_export(written(tmp_path / out, "glb", states), RATE)
    assert read.head.world.metres_per_unit == corner.WORLD.metres_per_unit
    np.testing.assert_allclose(read.times, (FIRST + np.arange(4)) / RATE)
    assert_states(read, states)
    assert read.parts() is None
    assert any("no times" in remark for remark in read.remarks)


@pytest.mark.parametrize("suffix", [".usdc", ".usdz"])
def test_usd_comes_back_with_its_times_and_parts(tmp_path, suffix):
    pytest.importorskip("pxr", reason="pip install 'scas4d[exports]'")
    states = sequence(changes=True)
    read = open_export(written(tmp_path / f"a{suffix}", "usd", states))
    np.testing.assert_allclose(read.times, 2 + np.arange(4) / RATE, atol=1e-6)
    assert read.head.frames_per_second == RATE
    assert_states(read, states)
    labels = dict(zip(read.known.ids.tolist(), read.parts().tolist(), strict=True))
    assert labels == {**dict(zip(states[0].ids.tolist(), moving.LABELS.tolist(), strict=True)), 97: -1}


def test_numbered_ply_comes_back_where_all_files_have_the_same(tmp_path):
    states = sequence(changes=False)
    read = open_export(written(tmp_path / "folder", "ply", states), RATE)
    backs = [state for _, _, state in read.states()]
    limits = {"means": 1e-4, "covariances": 1e-5, "colours": 1e-6, "opacities": 1e-6}
    for back, truth in zip(backs, states, strict=True):
        assert back.ids.tolist() == list(range(len(truth)))
        corner.assert_same(found(back, read), corner.wanted(truth), **limits)
    other = open_export(written(tmp_path / "other", "ply", sequence(changes=True)), RATE)
    with pytest.raises(InputError, match=r"frame_000006.ply does not have the same Gaussians as frame_000005.ply"):
        list(other.states())


@pytest.mark.parametrize("format", ["glb", "usd"])
def test_what_was_read_goes_out_the_same(tmp_path, format):
    if format == "usd":
        pytest.importorskip("pxr", reason="pip install 'scas4d[exports]'")
    name = "out" if format == "glb" else "out.usdc"
    states = sequence(changes=True)
    read = open_export(written(tmp_path / name, format, states), RATE)
    middle = tmp_path / "a.s4d"
    export_sequence(read.states(), "s4d", middle, world=read.head.world, parts=read.parts())
    with CompactReader(middle) as reader:
        assert reader.frames == list(read.frames)
        assert (reader.parts() is None) == (format == "glb")
        for index, state in zip(reader.frames, states, strict=True):
            back = reader.state(index)
            assert set(back.ids[back.present].tolist()) == set(state.ids[state.present].tolist())
    again = tmp_path / f"again-{name}"
    export_sequence(read.states(), format, again, world=read.head.world, parts=read.parts(), frames_per_second=RATE)
    second = open_export(again, RATE)
    for (_, _, one), (_, _, two) in zip(read.states(), second.states(), strict=True):
        np.testing.assert_array_equal(one.ids, two.ids)
        np.testing.assert_array_equal(one.present, two.present)
        np.testing.assert_allclose(one.means, two.means, atol=1e-6)
        np.testing.assert_allclose(one.factors, two.factors, atol=1e-6)


def test_a_part_of_the_frames_has_the_rows_of_all(tmp_path):
    read = open_export(written(tmp_path / "out", "glb", sequence(changes=True)), RATE)
    ((index, _, state),) = read.states(FIRST + 1, FIRST + 1)
    assert index == FIRST + 1
    assert len(state) == 10
    assert state.retired.nonzero()[0].tolist() == [1, 2]
    np.testing.assert_allclose(state.means[1], moving.state(0).means[1] + found_shift(read), atol=1e-5)


def found_shift(read: ExportedStates) -> np.ndarray:
    """The inside world of a file is the user's in metres."""
    return corner.WORLD.origin * corner.WORLD.metres_per_unit


@pytest.mark.parametrize("format", ["splat", "spz", "glb-parts", "tracks", "poses", "tapvid-mv"])
def test_formats_that_lose_the_states_are_refused_in_words(tmp_path, format):
    if format == "spz":
        pytest.importorskip("gsply", reason="pip install 'scas4d[exports]'")
    kind = FORMATS[format]
    name = "folder" if kind.numbered else f"a{kind.suffixes[0]}"
    with pytest.raises(InputError) as told:
        open_export(written(tmp_path / name, format, sequence(changes=False)))
    assert "--format" in told.value.remedy


def test_what_is_no_export_is_refused(tmp_path):
    folder = written(tmp_path / "folder", "glb", sequence(changes=False))
    first = folder / "frame_000005.glb"
    cases = {"a.zip": b"PK", "a.glb": first.read_bytes()[:40], "b.glb": b"x" * 64, "a.ply": b"ply\n", "a.txt": b""}
    for name, data in cases.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError):
            list(open_export(tmp_path / name).states())
    for wrong in (tmp_path / "nowhere.glb", tmp_path):
        with pytest.raises(InputError):
            open_export(wrong)
    with pytest.raises(InputError, match="frames_per_second"):
        open_export(folder, 0)
    first.write_bytes(first.read_bytes().replace(b'"_ID"', b'"_IX"'))
    with pytest.raises(InputError, match="no ids"):
        open_export(folder)
    shutil.copy(folder / "frame_000006.glb", folder / "frame_000005.glb")
    (folder / "frame_000007.ply").write_bytes(b"")
    with pytest.raises(InputError, match=r"\.glb, \.ply"):
        open_export(folder)
    with zipfile.ZipFile(tmp_path / "b.zip", "w") as archive:
        archive.writestr("readme.txt", "x")
    with pytest.raises(InputError, match="no numbered files"):
        open_export(tmp_path / "b.zip")


def test_usd_without_parts_comes_back(tmp_path):
    path = tmp_path / "a.usdc"
    states = sequence(False)
    coming = ((FIRST + k, k / RATE, state) for k, state in enumerate(states))
    export_sequence(coming, "usd", path, world=corner.WORLD, frames_per_second=RATE)
    read = open_export(path)
    assert read.parts() is None
    assert_states(read, states)


def test_usd_without_ids_is_refused(tmp_path):
    from pxr import Usd

    path = written(tmp_path / "a.usda", "usd", sequence(False)[:2])
    stage = Usd.Stage.Open(str(path))
    stage.GetPrimAtPath("/World/Gaussians").RemoveProperty("primvars:scas4d:id")
    stage.Save()
    del stage
    with pytest.raises(InputError, match="has no ids"):
        open_export(path)


def _changed(data, change):
    """A .glb with another document."""
    length = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + length])
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = data[:8] + (len(data) - length + len(text)).to_bytes(4, "little")
    return head + len(text).to_bytes(4, "little") + data[16:20] + text + data[20 + length :]


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d["accessors"][0].update(count=10**30),
        lambda d: d["accessors"][0].update(count=-3),
        lambda d: d.update(bufferViews="none"),
        lambda d: d.update(asset=[]),
        lambda d: d["asset"].update(extras=None),
        lambda d: d["asset"]["extras"].update(metres_per_unit=10**400),
        lambda d: d["accessors"][d["meshes"][0]["primitives"][0]["attributes"]["_ID"]].update(count=2),
        lambda d: d.update(meshes=[{}]),
    ],
)
def test_a_hostile_glb_is_refused_in_words(tmp_path, change):
    folder = written(tmp_path / "out", "glb", sequence(False)[:2])
    path = folder / f"frame_{FIRST + 1:06d}.glb"
    path.write_bytes(_changed(path.read_bytes(), change))
    with pytest.raises(InputError, match=r"frame_?\s?0*6"):
        list(open_export(folder).states())


def test_zips_that_hide_their_size_and_files_of_one_frame_are_refused(tmp_path, monkeypatch):
    folder = written(tmp_path / "out", "glb", sequence(False)[:2])
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("frame_000000.glb", bytes(300_000))
    monkeypatch.setattr(sources, "LARGEST", 200_000)
    with pytest.raises(InputError, match="at most 200000"):
        open_export(path)
    shutil.copy(folder / f"frame_{FIRST:06d}.glb", folder / f"frame_{FIRST}.glb")
    with pytest.raises(InputError, match="several files for one frame"):
        open_export(folder)
