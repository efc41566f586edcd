"""Importers share the little capture of the client's tests."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

SIZE = (24, 16)


@pytest.fixture(scope="session")
def capture_folder(tmp_path_factory):
    """Two cameras, four frames in the Dynamic3DGaussians layout, with masks and a cloud of 5 points."""
    folder = tmp_path_factory.mktemp("captures") / "tiny"
    k = [[20.0, 0, 12], [0, 20, 8], [0, 0, 1]]
    meta = {"w": 24, "h": 16, "k": [[k, k]] * 4, "w2c": [[np.eye(4).tolist()] * 2] * 4, "cam_id": [[0, 1]] * 4}
    meta["fn"] = [[f"{i}/{t:06d}.png" for i in (0, 1)] for t in range(4)]
    for kind, mode in (("ims", "RGB"), ("seg", "L")):
        for name in (name for row in meta["fn"] for name in row):
            (folder / kind / name).parent.mkdir(parents=True, exist_ok=True)
            Image.new(mode, SIZE, 1 if mode == "L" else (1, 2, 3)).save(folder / kind / name)
    (folder / "train_meta.json").write_text(json.dumps(meta))
    np.savez(folder / "init_pt_cld.npz", data=np.full((5, 7), 0.5, np.float32))
    return folder
