"""Recordings for the Rerun viewer, read back by its SDK."""

from __future__ import annotations

import numpy as np
import pytest
from export_cases.blob import BLOB, FRAMES, RATE, WORLD, centre, make_rig
from typer.testing import CliRunner

from client.cli.extras import install_hint
from client.cli.main import app
from client.exports.recording import make_recording
from client.wire import part_colour
from scas4d_core.errors import InputError


def made(source, out, **more):
    return make_recording(str(source), out, url="http://127.0.0.1:9", token=None, **more)


def named(batch):
    """Names and values of the columns; durations in nanoseconds."""
    import pyarrow

    columns = [one.cast(pyarrow.int64()) if pyarrow.types.is_temporal(one.type) else one for one in batch.columns]
    return batch.schema.names, [one.to_pylist() for one in columns]


def read(path):
    """Columns by entity: name to the values of each row, in order of the frames; and those without a time."""
    chunk = pytest.importorskip("rerun.chunk")
    found: dict[str, dict[str, list]] = {}
    for one in chunk.RrdReader(path).stream():
        columns = found.setdefault(one.entity_path, {})
        for name, values in zip(*named(one.to_record_batch()), strict=True):
            columns.setdefault(name, []).extend(values)
    for columns in found.values():
        if "frame" in columns:
            order = np.argsort(columns["frame"])
            for name, values in columns.items():
                if len(values) == len(order):  # what never changes may be in other chunks
                    columns[name] = [values[row] for row in order]
    return found


def test_a_recording_holds_points_tracks_cameras_and_times(source, tmp_path):
    pytest.importorskip("rerun")
    found = read(made(source, tmp_path / "a.rrd", tracks=1, trail=0.25))
    points, tracks = found["/world/gaussians"], found["/world/tracks"]
    assert points["frame"] == list(range(FRAMES))
    assert np.array(points["seconds"]) / 1e9 == pytest.approx(np.arange(FRAMES) / RATE)
    for frame, places in enumerate(points["Points3D:positions"]):
        assert np.shape(places) == (293, 3)
        assert np.mean(places[:BLOB], axis=0) == pytest.approx(WORLD.to_user(centre(frame)), abs=0.6)  # centimetres
    colours = np.array(points["Points3D:colors"][0], np.uint32)
    assert (colours[0] >> 24, colours[0] & 0xFFFFFF) == (255, 0xFF)  # red, opaque
    assert set(points["Points3D:class_ids"][0][:BLOB]) == {2}
    assert set(points["Points3D:class_ids"][0][BLOB:]) == {0}
    assert points["Points3D:radii"][0][BLOB] == pytest.approx(16, rel=0.1)  # the wall's, 0.16 m
    lengths = [[len(strip) for strip in strips] for strips in tracks["LineStrips3D:strips"]]
    assert lengths == [[], [2], [3], [3], [3]]
    for name, camera in zip(("front", "side"), make_rig().cameras, strict=True):
        columns = found[f"/world/cameras/{name}"]
        assert columns["Transform3D:translation"][0][0] == pytest.approx(camera.centre, rel=1e-6)
        turned = np.reshape(columns["Transform3D:mat3x3"][0][0], (3, 3))  # column by column
        assert turned == pytest.approx(camera.rotation, abs=1e-6)
        assert columns["Pinhole:resolution"][0][0] == [80, 60]


def test_points_by_part_have_the_colour_of_their_class(source, tmp_path):
    pytest.importorskip("rerun")
    found = read(made(source, tmp_path / "a.rrd", parts=True, frames="1:2", tracks=0))
    assert "Points3D:colors" not in found["/world/gaussians"]
    assert found["/world/gaussians"]["frame"] == [1, 2]
    ((classes,),) = found["/world"]["AnnotationContext:context"]
    labels = {one["class_id"]: one["class_description"]["info"] for one in classes}
    assert labels[2]["label"] == "part 1"
    red, green, blue = part_colour(1)
    assert labels[2]["color"] >> 8 == (red << 16) + (green << 8) + blue


def test_faults_and_a_package_that_is_missing(source, tmp_path):
    with pytest.raises(InputError, match=r"has the unsupported suffix '.mp4'; use .rrd"):
        made(source, tmp_path / "a.mp4")
    said = install_hint(ModuleNotFoundError("No module named 'rerun'", name="rerun"))
    assert said is not None
    assert said.endswith("pip install -e '.[rerun]'")
    assert not list(tmp_path.iterdir())


def test_the_command_asks_for_the_package(source, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "rerun", None)
    done = CliRunner().invoke(app, ["rerun", str(source), "--out", str(tmp_path / "a.rrd")])
    assert isinstance(done.exception, ModuleNotFoundError)
    assert done.exception.name == "rerun"
    assert not list(tmp_path.iterdir())
