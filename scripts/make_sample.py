"""Makes samples/robot from a capture in the Dynamic3DGaussians layout, with fewer cameras and frames.

    python scripts/make_sample.py CAPTURE samples/robot --cameras 16 --tests 2 --frames 14

Frames are removed from the end only. Camera ids do not change, because ``visible`` in gt_tracks.npz is indexed by
them. Images, masks and labels are copied byte for byte.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

LIMIT_MB = 6.0


def spread(centres: NDArray[np.float64], count: int) -> list[int]:
    """Returns ``count`` sorted indices of camera centres far apart, by farthest-point sampling from the first."""
    chosen = [0]
    while len(chosen) < count:
        distances = np.linalg.norm(centres[:, None] - centres[chosen], axis=-1).min(axis=1)
        chosen.append(int(distances.argmax()))
    return sorted(chosen)


def cut_meta(meta: dict[str, Any], frames: int, cameras: list[int]) -> dict[str, Any]:
    """Returns the contents of a train_meta or test_meta file for the first ``frames`` frames and the given cameras.

    Args:
        meta: parsed contents of the file.
        frames: number of frames to keep.
        cameras: indices of the cameras to keep.
    """
    return {
        key: [[row[camera] for camera in cameras] for row in value[:frames]] if isinstance(value, list) else value
        for key, value in meta.items()
    }


def main() -> None:
    """Writes the reduced capture. Exits with an error if it is larger than ``LIMIT_MB``."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", type=Path)
    parser.add_argument("target", type=Path)
    parser.add_argument("--cameras", type=int, default=16)
    parser.add_argument("--tests", type=int, default=2)
    parser.add_argument("--frames", type=int, default=14)
    options = parser.parse_args()
    kept: dict[str, list[int]] = {}
    for file, count in (("train_meta.json", options.cameras), ("test_meta.json", options.tests)):
        meta = json.loads((options.source / file).read_text())
        poses = np.array(meta["w2c"][0])
        centres = -np.einsum("cji,cj->ci", poses[:, :3, :3], poses[:, :3, 3])
        meta = cut_meta(meta, options.frames, spread(centres, count))
        kept[file] = meta["cam_id"][0]
        options.target.mkdir(parents=True, exist_ok=True)
        (options.target / file).write_text(json.dumps(meta, separators=(",", ":")))
        for row in meta["fn"]:
            for name in row:
                for folder in ("ims", "seg", "gt_parts"):
                    if (options.source / folder / name).exists():
                        (options.target / folder / name).parent.mkdir(parents=True, exist_ok=True)
                        shutil.copyfile(options.source / folder / name, options.target / folder / name)
    shutil.copyfile(options.source / "init_pt_cld.npz", options.target / "init_pt_cld.npz")
    with np.load(options.source / "gt_tracks.npz") as file:
        tracks = {key: file[key] for key in file.files}
    for key in ("points", "visible"):
        tracks[key] = tracks[key][: options.frames]
    np.savez_compressed(options.target / "gt_tracks.npz", **tracks)
    scene = json.loads((options.source / "scene.json").read_text())
    scene["frames"] = options.frames
    scene["train_cams"], scene["test_cams"] = kept["train_meta.json"], kept["test_meta.json"]
    # Measured on the whole capture; not valid for the sample, which has fewer cameras and frames.
    del scene["motion_px_per_frame"], scene["test_to_nearest_train_deg"]
    for part in scene["parts"]:
        if part.get("pose") is not None:
            part["pose"] = part["pose"][: options.frames]
    (options.target / "scene.json").write_text(json.dumps(scene, separators=(",", ":")))
    size = sum(path.stat().st_size for path in options.target.rglob("*") if path.is_file()) / 1e6
    print(f"{options.target}: {size:.2f} MB, cameras {kept}")
    if size > LIMIT_MB:
        raise SystemExit(f"{size:.2f} MB exceeds {LIMIT_MB} MB: take fewer cameras or frames")


if __name__ == "__main__":
    main()
