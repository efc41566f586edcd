"""Sequences: files and names, memory, and what is refused."""

import re
import weakref
import zipfile
from pathlib import Path

import numpy as np
import pytest
from export_cases import corner, moving

from scas4d_core.errors import InputError
from scas4d_core.exports import FORMATS, export_sequence
from scas4d_core.exports.sequence import FRAME_WRITERS
from scas4d_core.gaussians import Gaussians
from scas4d_core.query.ply import read_ply

ROOT = Path(__file__).parents[3]
NUMBERED = [name for name, each in FORMATS.items() if each.numbered]
PACKAGES = {"spz": ("gsply",), "spz4": ("gsply", "zstandard"), "usd": ("pxr",)}
WHOLE = [name for name, each in FORMATS.items() if not each.numbered]


@pytest.fixture(autouse=True)
def _packages(request):
    """Formats whose package is missing are skipped."""
    name = getattr(request.node, "callspec", None) and request.node.callspec.params.get("format")
    for package in PACKAGES.get(name, ()):
        pytest.importorskip(package, reason=f"{name} needs {package}: pip install 'scas4d[exports]'")


def states(count=3, first=12):
    return ((first + frame, frame / 25, moving.state(frame)) for frame in range(count))


def exported(out, format, given=None, **about):
    about = {"world": corner.WORLD, "parts": moving.LABELS, "rig": corner.rig(), **about}
    return export_sequence(states() if given is None else given, format, out, **about)


def names(folder):
    return sorted(path.name for path in folder.rglob("*") if path.is_file())


@pytest.mark.parametrize("format", NUMBERED)
def test_numbered_files_in_a_folder(tmp_path, format):
    told = []
    paths = exported(tmp_path / "new" / "out", format, progress=lambda *done: told.append(done))
    suffix = FORMATS[format].suffixes[0]
    assert [path.name for path in paths] == [f"frame_{index:06d}{suffix}" for index in (12, 13, 14)]
    assert names(tmp_path) == [path.name for path in paths]
    assert told == [(12, 1), (13, 2), (14, 3)]
    FRAME_WRITERS[format](tmp_path / f"b{suffix}", moving.state(1), corner.WORLD)
    assert paths[1].read_bytes()[-200:] == (tmp_path / f"b{suffix}").read_bytes()[-200:]


@pytest.mark.parametrize("format", NUMBERED)
def test_numbered_files_in_a_zip(tmp_path, format):
    assert exported(tmp_path / "a.zip", format) == [tmp_path / "a.zip"]
    assert names(tmp_path) == ["a.zip"]
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        suffix = FORMATS[format].suffixes[0]
        assert archive.namelist() == [f"frame_{index:06d}{suffix}" for index in (12, 13, 14)]
        assert archive.testzip() is None


@pytest.mark.parametrize("format", WHOLE)
def test_one_file(tmp_path, format):
    out = tmp_path / f"a{FORMATS[format].suffixes[0]}"
    assert exported(out, format, frames_per_second=25) == [out]
    assert names(tmp_path) == [out.name]
    assert out.stat().st_size > 100


def test_retired_ones_are_left_out(tmp_path):
    (path,) = exported(tmp_path, "ply", [(0, 0.0, moving.state(0).retire([1, 2]))])
    assert len(read_ply(path)) == 8


@pytest.mark.parametrize("format", FORMATS)
def test_a_frame_without_gaussians(tmp_path, format):
    """All may have left; a frame of none is a frame."""
    given = [(frame, frame / 25, moving.state(0).retire(np.full(10, frame == 1))) for frame in range(3)]
    each = FORMATS[format]
    paths = exported(tmp_path / "out" if each.numbered else tmp_path / f"a{each.suffixes[0]}", format, given)
    assert len(paths) == (3 if each.numbered else 1)


@pytest.mark.parametrize("format", FORMATS)
def test_one_state_is_held_at_a_time(tmp_path, format):
    """The first may stay, as the parts' rest; others are let go."""
    alive: list[weakref.ref[Gaussians]] = []
    most = 0

    def watched():
        nonlocal most
        for frame in range(6):
            state = moving.state(frame)
            alive.append(weakref.ref(state))
            yield frame, frame / 25, state
            del state
            most = max(most, sum(each() is not None for each in alive[1:]))

    each = FORMATS[format]
    exported(tmp_path / "out" if each.numbered else tmp_path / f"a{each.suffixes[0]}", format, watched())
    assert len(alive) == 6
    assert most <= 1


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize("zipped", [False, True])
def test_an_error_leaves_nothing_half_written(tmp_path, format, zipped):
    def failing():
        yield from states(2)
        raise KeyError("no such frame")

    each = FORMATS[format]
    if zipped and not each.numbered:
        return
    out = tmp_path / "a.zip" if zipped else tmp_path / ("out" if each.numbered else f"a{each.suffixes[0]}")
    with pytest.raises(KeyError, match="no such frame"):
        exported(out, format, failing())
    whole = [] if zipped or not each.numbered else [f"frame_0000{k}{each.suffixes[0]}" for k in (12, 13)]
    assert names(tmp_path) == whole
    assert [path for path in tmp_path.iterdir() if path.name != "out"] == []


@pytest.mark.parametrize("format", FORMATS)
def test_an_empty_range(tmp_path, format):
    each = FORMATS[format]
    out = tmp_path / ("out" if each.numbered else f"a{each.suffixes[0]}")
    with pytest.raises(InputError, match="states has no frames; use a range that contains at least one"):
        exported(out, format, [])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("format", FORMATS)
def test_an_output_that_cannot_be_written(tmp_path, format):
    (tmp_path / "file").write_text("here already")
    each = FORMATS[format]
    outs = [tmp_path / "file" / f"a{each.suffixes[0]}"]
    if each.numbered:
        outs = [tmp_path / "file", tmp_path / "file" / "a.zip"]
    for out in outs:
        with pytest.raises(
            InputError, match=r"out '.*file.*' cannot be written \(.*\); use a path in an existing, writable folder"
        ):
            exported(out, format)
    assert names(tmp_path) == ["file"]


def test_what_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"unknown format 'obj'; choose from ply, splat, spz, .*poses"):
        exported(tmp_path, "obj")
    for format in ("glb-parts", "poses"):
        with pytest.raises(InputError, match=f"format '{format}' requires parts, but parts is None; pass one label"):
            export_sequence(states(), format, tmp_path / "a.glb", world=corner.WORLD)
    with pytest.raises(InputError, match=r"format 'tapvid-mv' requires cameras, but rig is None; pass a rig"):
        exported(tmp_path / "a.zip", "tapvid-mv", rig=None)
    with pytest.raises(InputError, match=r"out '.*a\.glb' has the wrong suffix for format 'usd'; use \.usdc"):
        exported(tmp_path / "a.glb", "usd")
    with pytest.raises(InputError, match=r"invalid frames_per_second 0; use a positive number or None"):
        exported(tmp_path / "a.usda", "usd", frames_per_second=0)
    assert not list(tmp_path.iterdir())


def test_a_missing_package_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "gsply", None)
    with pytest.raises(InputError, match=r"format 'spz' requires the package gsply.*'.\[exports\]'"):
        exported(tmp_path, "spz")
    monkeypatch.setitem(__import__("sys").modules, "pxr.Usd", None)
    with pytest.raises(InputError, match=r"format 'usd' requires the package pxr\.Usd, which is not installed"):
        exported(tmp_path / "a.usda", "usd")


def test_from_a_compact_file(tmp_path):
    pytest.importorskip("zstandard", reason="compact files need zstandard")
    from scas4d_core.compact import CompactReader, CompactWriter, FileHeader

    with CompactWriter(tmp_path / "a.s4d", FileHeader(corner.WORLD, rig=corner.rig())) as writer:
        for index, time, state in states():
            writer.add(index, time, state)
    with CompactReader(tmp_path / "a.s4d") as reader:
        given = ((index, time, reader.state(index)) for index, time in zip(reader.frames, reader.times, strict=True))
        paths = export_sequence(given, "ply", tmp_path / "out", world=reader.head.world, rig=reader.head.rig)
        truth = corner.wanted(reader.state(14)).means
    assert [path.name for path in paths] == [f"frame_0000{k}.ply" for k in (12, 13, 14)]
    np.testing.assert_allclose(read_ply(paths[2]).means, truth, atol=2e-5)


def test_the_page_lists_the_formats():
    """The table has the names, suffixes and kinds of output; formats that differ only in their names share a row."""
    page = (ROOT / "docs" / "exports.md").read_text()
    rows = re.findall(
        r"^\| ((?:`[a-z0-9-]+`(?:, )?)+) \| ((?:`\.[a-z0-9]+` ?)+) \| (one file(?: per frame)?) \|", page, re.M
    )
    listed = {
        name: (tuple(re.findall(r"`(\.\w+)`", suffixes)), kind == "one file per frame")
        for names, suffixes, kind in rows
        for name in re.findall(r"[a-z0-9-]+", names)
    }
    assert listed == {name: (each.suffixes, each.numbered) for name, each in FORMATS.items()}
