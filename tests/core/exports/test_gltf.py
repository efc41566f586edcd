"""glTF, read by pygltflib."""

import json
import struct

import numpy as np
import pytest
from export_cases import corner, gltf_reader

from scas4d_core.errors import InputError
from scas4d_core.exports.glb import Binary
from scas4d_core.exports.gltf import EXACT_IDS, write_glb
from scas4d_core.gaussians import Gaussians

pytest.importorskip("pygltflib", reason="the test reads with pygltflib")
LIMITS = {"means": 2e-7, "covariances": 3e-6, "colours": 1e-6, "opacities": 1e-7}
SPLAT = "KHR_gaussian_splatting"


def test_by_pygltflib(tmp_path):
    state = corner.state()
    write_glb(tmp_path / "a.glb", state, corner.WORLD)
    found = gltf_reader.Asset(tmp_path / "a.glb")
    (node,) = found.nodes()
    assert node.matrix is None and node.rotation is None and node.translation is None  # noqa: PT018
    of = found.splats(node)
    corner.assert_same(of, corner.wanted(state, corner.Y_UP, metres=True), **LIMITS)
    corner.assert_y_up(of.means)
    assert found.attribute(node, "_ID").tolist() == state.ids.tolist()


def test_the_document_keeps_to_the_extension(tmp_path):
    write_glb(tmp_path / "a.glb", corner.state(gloss=True), corner.WORLD)
    found = gltf_reader.Asset(tmp_path / "a.glb")
    assert found.document.extensionsUsed == [SPLAT]
    assert not found.document.extensionsRequired  # others show points
    (primitive,) = found.document.meshes[0].primitives
    assert primitive.mode == 0
    assert primitive.extensions[SPLAT] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    kinds = {
        name: (found.document.accessors[place].type, found.document.accessors[place].componentType)
        for name, place in vars(primitive.attributes).items()
        if place is not None
    }
    assert kinds.pop("POSITION") == ("VEC3", 5126)
    assert kinds.pop("COLOR_0") == ("VEC4", 5123)
    assert kinds.pop("_ID") == ("SCALAR", 5126)
    harmonics = {f"{SPLAT}:SH_DEGREE_{d}_COEF_{n}": ("VEC3", 5126) for d in range(4) for n in range(2 * d + 1)}
    assert kinds == harmonics | {
        f"{SPLAT}:ROTATION": ("VEC4", 5126),
        f"{SPLAT}:SCALE": ("VEC3", 5126),
        f"{SPLAT}:OPACITY": ("SCALAR", 5126),
    }
    (node,) = found.nodes()
    rotations = found.attribute(node, f"{SPLAT}:ROTATION")
    np.testing.assert_allclose(np.linalg.norm(rotations, axis=1), 1, atol=1e-6)
    assert found.attribute(node, f"{SPLAT}:SCALE").min() > 0
    bounds = found.document.accessors[primitive.attributes.POSITION]
    means = found.attribute(node, "POSITION")
    assert (bounds.min, bounds.max) == (means.min(axis=0).tolist(), means.max(axis=0).tolist())


def test_gloss_is_turned_with_the_axes(tmp_path):
    state = corner.state(gloss=True)
    write_glb(tmp_path / "a.glb", state, corner.WORLD)
    found = gltf_reader.Asset(tmp_path / "a.glb")
    harmonics = found.harmonics(found.nodes()[0])
    truth = corner.seen_truly(state)
    np.testing.assert_allclose(corner.seen(harmonics, corner.Y_UP), truth, atol=1e-5)
    assert np.abs(corner.seen(harmonics, np.ones(3)) - truth).max() > 0.1


def test_points_have_linear_light_for_readers_without_the_extension(tmp_path):
    state = corner.state()
    write_glb(tmp_path / "a.glb", state, corner.WORLD)
    found = gltf_reader.Asset(tmp_path / "a.glb")
    shown = found.attribute(found.nodes()[0], "COLOR_0") / 65535
    encoded = np.where(shown[:, :3] <= 0.0031308, 12.92 * shown[:, :3], 1.055 * shown[:, :3] ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(encoded, state.colours, atol=2e-4)
    np.testing.assert_allclose(shown[:, 3], state.opacities, atol=1e-5)


def test_retired_ones_are_left_out_and_ids_stay(tmp_path):
    state = corner.state().retire([0, 4])
    write_glb(tmp_path / "a.glb", state, corner.WORLD)
    found = gltf_reader.Asset(tmp_path / "a.glb")
    assert found.attribute(found.nodes()[0], "_ID").tolist() == [51, 52, 53, 55, 56, 57, 58, 59]


def test_ids_that_float32_cannot_hold_are_left_out(tmp_path):
    state = corner.state()
    write_glb(tmp_path / "a.glb", state.replace(ids=state.ids + EXACT_IDS), corner.WORLD)
    assert b'"_ID"' not in (tmp_path / "a.glb").read_bytes()


def test_a_frame_without_gaussians_is_an_empty_scene(tmp_path):
    write_glb(tmp_path / "a.glb", corner.state().retire(np.ones(corner.COUNT, bool)), corner.WORLD)
    found = gltf_reader.Asset(tmp_path / "a.glb")
    assert found.document.meshes == []
    assert found.document.asset.extras["metres_per_unit"] == 0.01


def test_chunks_are_whole_words(tmp_path):
    write_glb(tmp_path / "a.glb", Gaussians.of_points([[0, 0, 1]], 0.1), corner.WORLD)
    content = (tmp_path / "a.glb").read_bytes()
    magic, version, total = struct.unpack("<4sII", content[:12])
    assert (magic, version, total) == (b"glTF", 2, len(content))
    length, kind = struct.unpack("<I4s", content[12:20])
    assert kind == b"JSON"
    assert length % 4 == 0
    document = json.loads(content[20 : 20 + length])
    binary, kind = struct.unpack("<I4s", content[20 + length : 28 + length])
    assert kind == b"BIN\0"
    assert binary == document["buffers"][0]["byteLength"] == total - 28 - length
    assert all(view["byteOffset"] % 4 == 0 for view in document["bufferViews"])


def test_too_large_or_unwritable(tmp_path, monkeypatch):
    monkeypatch.setattr("scas4d_core.exports.glb.LONGEST", 100)
    with pytest.raises(InputError, match=r"bytes, but a \.glb file can have at most 4 GiB; export as ply"):
        write_glb(tmp_path / "a.glb", corner.state(), corner.WORLD)
    monkeypatch.undo()
    with pytest.raises(InputError, match=r"out '.*' cannot be written"):
        Binary().write(tmp_path / "no" / "a.glb", {})
    assert not list(tmp_path.iterdir())
