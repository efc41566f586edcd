"""Every example in the docstrings of the core runs, and every public name has one (the client: tests/client)."""

from __future__ import annotations

import ast
import doctest
import importlib
import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE

PUBLIC: dict[str, tuple[str, ...]] = {
    "scas4d_core.cameras": ("Camera", "Rig", "WorldFrame", "rig_inside"),
    "scas4d_core.captures": ("open_capture",),
    "scas4d_core.captures.capture": ("Capture",),
    "scas4d_core.captures.frame": ("Frame", "InitialPoints"),
    "scas4d_core.captures.ground_truth": ("GroundTruth",),
    "scas4d_core.captures.images": ("decode_image", "decode_mask", "decode_labels", "resize_area", "picture_size"),
    "scas4d_core.exports.formats": ("format_of",),
    "scas4d_core.exports.gltf": ("write_glb",),
    "scas4d_core.exports.gltf_parts": ("PartAsset",),
    "scas4d_core.exports.sequence": ("export_sequence",),
    "scas4d_core.exports.splat": ("write_splat",),
    "scas4d_core.exports.spz": ("write_spz",),
    "scas4d_core.exports.tables": ("PoseTable", "TrackTable"),
    "scas4d_core.exports.usd": ("UsdSequence",),
    "scas4d_core.effects.presence.motion_mask": ("changed_pixels", "with_reliable_labels"),
    "scas4d_core.errors": ("message_of", "without_paths"),
    "scas4d_core.first_frame.initial_points": ("initial_points",),
    "scas4d_core.gaussians": ("Gaussians", "moving_extent", "quaternions_to_matrices"),
    "scas4d_core.guards": ("GuardCounts",),
    "scas4d_core.metrics.image": ("flip", "lpips", "psnr", "ssim"),
    "scas4d_core.metrics.parts": ("adjusted_rand_index",),
    "scas4d_core.metrics.tracks": (
        "error_by_confidence", "lost_parts", "median_trajectory_error", "oracle_tracks", "track_error_3d",
        "visibility_accuracy",
    ),
    "scas4d_core.query.carriers": ("carriers", "geometric_median"),
    "scas4d_core.query.committed": ("CommittedScene",),
    "scas4d_core.query.joints": ("find_joints",),
    "scas4d_core.query.part_motion": ("PartMotion", "part_tracks", "rigid_motion"),
    "scas4d_core.query.parts": ("match_labels", "parts"),
    "scas4d_core.query.ply": ("read_ply", "split_factors", "write_ply"),
    "scas4d_core.query.ray_depth": ("ray_depths",),
    "scas4d_core.query.tapvid3d": ("tapvid3d",),
    "scas4d_core.query.tracks": ("tracks_of_ids", "tracks_of_pixels", "tracks_of_points"),
    "scas4d_core.query.view": ("View", "ViewRenderer"),
    "scas4d_core.engines.choose": ("engine_of",),
    "scas4d_core.engines.cpu.rasterizer": ("CpuRasterizer",),
    "scas4d_core.engines.engine": ("EngineError",),
    "scas4d_core.engines.exposure": ("gain_to_exposure",),
    "scas4d_core.engines.limits": ("scene_limits",),
    "scas4d_core.engines.torch.rasterizer": ("render",),
    "scas4d_core.frame_outcome": ("FrameOutcome", "degraded_text"),
    "scas4d_core.presets": ("preset",),
    "scas4d_core.reconstruction": ("Reconstruction",),
    "scas4d_core.settings": ("SceneSettings", "StaticSettings", "UpdateSettings"),
    "scas4d_core.checkpoint": ("Checkpoints",),
    "scas4d_core.storage.history": ("History",),
    "scas4d_core.storage.npz": ("read_npz", "write_npz"),
    "scas4d_core.structure.hierarchy": ("build_hierarchy",),
    "scas4d_core.structure.neighbours": ("Neighbours",),
    "scas4d_core.engines.torch.deformation": (
        "cascade", "cluster_map", "cluster_pivots", "deform", "material_rotations", "polar_rotation",
        "quaternion_matrices", "quaternion_product", "rotation_quaternions", "scaling_factor",
    ),
    "scas4d_core.engines.torch.losses": (
        "floor_loss", "image_loss", "isometry_loss", "psnr", "rigidity_loss", "rotation_loss", "scale_loss",
        "soft_colour_loss", "ssim_map",
    ),
}  # fmt: skip
"""By module, the functions and classes whose docstring, or that of a method, holds an example."""

PACKAGES = {"scas4d_core.exports.spz": "gsply", "scas4d_core.exports.usd": "pxr"}
"""Packages of the extra ``exports`` that the examples of a module need."""


def module_path(name: str) -> Path:
    path = ROOT.joinpath(*name.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


WITH_EXAMPLES = sorted(
    module_name(path) for path in (ROOT / "scas4d_core").rglob("*.py") if ">>>" in path.read_text(encoding="utf-8")
)


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_the_examples_of_a_module_run(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if "import torch\n" in module_path(name).read_text(encoding="utf-8") and importlib.util.find_spec("torch") is None:
        pytest.skip("torch is not installed")
    if name in PACKAGES and importlib.util.find_spec(PACKAGES[name]) is None:
        pytest.skip(f"{PACKAGES[name]} is not installed: pip install 'scas4d[exports]'")
    monkeypatch.chdir(ROOT)  # examples name the sample by its path in a checkout
    failed, tried = doctest.testmod(importlib.import_module(name), optionflags=FLAGS)
    assert tried > 0
    assert failed == 0


@pytest.mark.parametrize(("module", "name"), [(module, name) for module, names in PUBLIC.items() for name in names])
def test_a_public_name_has_an_example(module: str, name: str) -> None:
    tree = ast.parse(module_path(module).read_text(encoding="utf-8"))
    kinds = (ast.FunctionDef, ast.ClassDef)
    (definition,) = [node for node in tree.body if isinstance(node, kinds) and node.name == name]
    documented = [definition, *(node for node in definition.body if isinstance(node, ast.FunctionDef))]
    assert any(">>>" in (ast.get_docstring(node) or "") for node in documented)
