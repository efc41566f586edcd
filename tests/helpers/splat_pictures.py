"""The CPU rasterizer's pictures of compact files, for comparison with those of the browser."""

from __future__ import annotations

import numpy as np

from scas4d_core.cameras import Camera, Rig
from scas4d_core.compact import CompactReader
from scas4d_core.engines.cpu.rasterizer import CpuRasterizer
from scas4d_core.engines.limits import scene_limits
from scas4d_core.engines.views import CameraArrays


def rendered(file, index, model, hidden_part=None):
    """The CPU rasterizer's picture [H, W, 3] of a frame, from a camera in the service's format."""
    with CompactReader(file) as reader:
        state, head = reader.state(index), reader.head
        if hidden_part is not None:
            parts = reader.parts()[: len(state)]
            state = state.retire(np.flatnonzero((parts == hidden_part) & state.present))
    camera = head.world.camera_to_inside(
        Camera("view", model["intrinsics"], np.array(model["world_to_camera"]), model["width"], model["height"])
    )
    inside = Rig(tuple(head.world.camera_to_inside(one) for one in head.rig.cameras))
    features = np.concatenate([state.colours, np.zeros((len(state), 1), np.float32)], axis=1)
    background = np.array([*head.background, 0], np.float32)
    picture = CpuRasterizer(scene_limits("auto", inside.radius)).forward(
        state.means, state.factors, state.opacities, features, CameraArrays.of(camera), background
    )
    return np.moveaxis(picture.features[:3], 0, -1).clip(0, 1)


def psnr(one, other):
    return -10 * np.log10(max(np.square(one - other).mean(), 1e-12))  # 120 dB if they are identical
