"""Reads .glb by pygltflib: attributes, harmonics, and where an animation puts a node."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from export_cases.corner import Found, covariances

SPLAT = "KHR_gaussian_splatting"
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
TYPES = {5126: "<f4", 5123: "<u2", 5121: "u1"}


class Asset:
    def __init__(self, path: Path) -> None:
        import pygltflib

        self.document = pygltflib.GLTF2().load_binary(str(path))
        self.blob = self.document.binary_blob()

    def nodes(self) -> list:
        """Nodes of the scene."""
        return [self.document.nodes[place] for place in self.document.scenes[self.document.scene].nodes]

    def accessor(self, place: int) -> np.ndarray:
        about = self.document.accessors[place]
        view = self.document.bufferViews[about.bufferView]
        begin = view.byteOffset + (about.byteOffset or 0)
        kind, width = np.dtype(TYPES[about.componentType]), WIDTHS[about.type]
        flat = np.frombuffer(self.blob, kind, about.count * width, begin)
        assert flat.nbytes <= view.byteLength
        return flat.astype(np.float64).reshape(-1, width) if width > 1 else flat.astype(np.float64)

    def attribute(self, node, name: str) -> np.ndarray:
        (primitive,) = self.document.meshes[node.mesh].primitives
        return self.accessor(getattr(primitive.attributes, name))

    def harmonics(self, node) -> np.ndarray:
        """[N, 16, 3]."""
        names = [f"{SPLAT}:SH_DEGREE_{d}_COEF_{n}" for d in range(4) for n in range(2 * d + 1)]
        return np.stack([self.attribute(node, name) for name in names], axis=1)

    def splats(self, node) -> Found:
        """Gaussians in the node's own frame, as the extension reads them."""
        return Found(
            self.attribute(node, "POSITION"),
            covariances(self.attribute(node, f"{SPLAT}:ROTATION"), self.attribute(node, f"{SPLAT}:SCALE")),
            0.5 + 0.2820947917738781 * self.attribute(node, f"{SPLAT}:SH_DEGREE_0_COEF_0"),
            self.attribute(node, f"{SPLAT}:OPACITY"),
        )

    def animated(self, node, seconds: float) -> Found:
        """Gaussians in the world at a time of the animation."""
        here = self.splats(node)
        shift, turn = self.pose(node, seconds)
        matrix = turn.as_matrix()
        return Found(here.means @ matrix.T + shift, matrix @ here.covariances @ matrix.T, here.colours, here.opacities)

    def pose(self, node, seconds: float) -> tuple[np.ndarray, Rotation]:
        """Translation and rotation of a node at a time of the animation."""
        turn, shift = Rotation.identity(), np.zeros(3)
        (animation,) = self.document.animations
        for channel in animation.channels:
            if self.document.nodes[channel.target.node] is node:
                sampler = animation.samplers[channel.sampler]
                assert sampler.interpolation == "LINEAR"
                times, values = self.accessor(sampler.input), self.accessor(sampler.output)
                if channel.target.path == "rotation":
                    turn = Slerp(times, Rotation.from_quat(values))(np.clip(seconds, times[0], times[-1]))
                else:
                    shift = np.array([np.interp(seconds, times, column) for column in values.T])
        return shift, turn
