"""The player of a source that tells no cameras: of USD, which keeps the ids, but whose cameras are not read back."""

from __future__ import annotations

import base64
import re

import numpy as np

from client.exports.export import export
from client.exports.player import export_player
from scas4d_core.compact import CompactReader


def test_what_was_read_back_is_seen_from_the_front(source, tmp_path):
    usd, page, file = tmp_path / "a.usdc", tmp_path / "a.html", tmp_path / "a.s4d"
    export(str(source), "usd", usd, url="", token=None)
    export_player(str(usd), page, url="", token=None)
    pieces = re.findall(r'<script type="application/octet-stream">(.*?)</script>', page.read_text())
    file.write_bytes(b"".join(map(base64.b64decode, pieces)))
    with CompactReader(file) as found, CompactReader(source / "states.s4d") as true:
        assert found.frames == true.frames
        (camera,) = found.head.rig.cameras
        state = found.state(found.frames[0])
        pixels, depth = camera.project(found.head.world.to_user(state.means[state.present]))
        assert (depth > 0).all()
        inside = ((pixels > 0) & (pixels < (camera.width, camera.height))).all(axis=1)
        assert inside.mean() > 0.8
        assert np.ptp(pixels, axis=0).max() > 100
