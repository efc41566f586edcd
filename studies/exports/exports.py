"""``scripts/bench exports``: every splat format, read by a third-party reader and compared with the state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial.transform import Rotation

from client import pictures
from client.cli.scores import Column, markdown
from client.importers.open_source import open_source
from scas4d_core import metrics
from scas4d_core.cameras import WorldFrame
from scas4d_core.engines.limits import rig_limits
from scas4d_core.exports.formats import FORMATS
from scas4d_core.exports.sequence import export_sequence
from scas4d_core.gaussians import Gaussians
from scas4d_core.query.committed import CommittedScene
from scas4d_core.query.parts import parts
from scas4d_core.query.ply import SH_DEGREE_0
from scas4d_core.settings import Settings
from scas4d_core.storage.history import History
from studies.exports.gltf import open_gltf

Float = NDArray[np.float64]
Y_UP = np.array([1.0, -1.0, -1.0])
IN_METRES = {"spz", "spz4", "glb", "glb-parts"}
"""Formats read by this study whose positions are in metres."""
SPLAT = "KHR_gaussian_splatting"
TITLE, GAP = 24, 12
"""Height of a title and gap between images on a contact sheet, in pixels."""


@dataclass(frozen=True)
class Found:
    """Gaussians returned by a reader, in the coordinates of the file.

    Attributes:
        means: [N, 3] means.
        rotations: [N, 4] quaternions (x, y, z, w).
        scales: [N, 3] lengths of the axes.
        colours: [N, 3] colours.
        opacities: [N] opacities.
    """

    means: Float
    rotations: Float
    scales: Float
    colours: Float
    opacities: Float

    def gaussians(self, axes: Float, world: WorldFrame, metres: bool) -> Gaussians:
        """Converts the Gaussians to internal world coordinates.

        Args:
            axes: signs that convert the file's axes to the internal ones.
            world: world frame of the scene.
            metres: whether the file is in metres rather than in the user's unit.
        """
        unit = 1.0 if metres else world.metres_per_unit
        turned = Rotation.from_quat(self.rotations).as_matrix() * self.scales[:, None, :] * unit
        means = self.means * axes / (world.metres_per_unit if metres else 1.0)
        state = Gaussians.of_points(world.to_inside(means), 1.0, self.colours)
        return state.replace(
            factors=(turned * axes[:, None]).astype(np.float32), opacities=self.opacities.astype(np.float32)
        )


@dataclass(frozen=True)
class ExportFigures:
    """Measurements of one export format.

    Attributes:
        format: format name.
        size: file size in bytes.
        psnr: PSNR between the renders of the export and of the state, averaged over cameras, in dB.
        reader: reader name.
        picture: image of state | export | difference, as seen by the first camera.
    """

    format: str
    size: int
    psnr: float
    reader: str
    picture: NDArray[np.uint8]


def measure(folder: Path, states: Path) -> list[ExportFigures]:
    """Exports the last committed state of a capture in every format, and renders the Gaussians that the readers return.

    The views are those of the test cameras, or of the training cameras if there are none. In `glb-parts`, the last
    state is the first state at the end of the animation.

    Args:
        folder: capture folder.
        states: folder that contains the capture's committed states.

    Returns:
        The measurements of each format.
    """
    capture = open_source(folder)
    history = History.load(states)
    index, state = history.indices[-1], history.newest
    world = capture.full_rig.world_frame(Settings().scene.metres_per_unit)
    cameras = (capture.test_rig or capture.rig).cameras
    exact = _rendered(state, world, history, cameras)
    figures = []
    with TemporaryDirectory() as temporary:
        for name, (reader, read, y_up) in READERS.items():
            single = FORMATS[name].numbered
            out = Path(temporary) / (name if single else f"{name}{FORMATS[name].suffixes[0]}")
            labels = parts(history) if FORMATS[name].needs_parts else None
            chosen = history.indices if labels is not None else [index]  # an asset contains the whole motion
            coming = ((each, history.time(each), history.gaussians(each)) for each in chosen)
            (file,) = export_sequence(coming, name, out, world=world, parts=labels)
            cloud = read(file).gaussians(Y_UP if y_up else np.ones(3), world, metres=name in IN_METRES)
            views = _rendered(cloud, world, history, cameras)
            psnr = float(np.mean([metrics.psnr(b, a) for a, b in zip(exact, views, strict=True)]))
            left, right = (pictures.eight_bit(each[0]) for each in (exact, views))
            compared = pictures.comparison(left, right)
            figures.append(ExportFigures(name, file.stat().st_size, psnr, reader, compared))
    return figures


COLUMNS = (
    Column("format", "format"),
    Column("file, MB", "megabytes"),
    Column("dB against the state", "psnr", ".1f"),
    Column("read by", "reader"),
)


def summarize(figures: list[ExportFigures]) -> str:
    """Formats the measurements as a Markdown table, with one row per format."""
    return markdown([vars(one) | {"megabytes": one.size / 1e6} for one in figures], COLUMNS)


def sheet(figures: list[ExportFigures], columns: int = 2) -> Image.Image:
    """Draws a contact sheet of state, export and difference for each format, as seen by the first test camera."""
    high, wide = figures[0].picture.shape[:2]
    rows = -(-len(figures) // columns)
    made = Image.new("RGB", (columns * (wide + GAP), rows * (high + TITLE)), "white")
    pen, font = ImageDraw.Draw(made), ImageFont.load_default(TITLE - 8)
    for number, one in enumerate(figures):
        x, y = number % columns * (wide + GAP), number // columns * (high + TITLE)
        pen.text((x + 4, y + 2), f"{one.format}: state | read by {one.reader} | difference x4", "black", font)
        made.paste(Image.fromarray(one.picture), (x, y + TITLE))
    return made


def _rendered(state: Gaussians, world: WorldFrame, of: History, cameras: Any) -> list[NDArray[np.float32]]:
    history = History()
    ids = np.arange(len(state), dtype=np.int64)
    history.append(0, 0.0, state.replace(ids=ids))
    limits = rig_limits(Settings().scene.near, world, cameras)
    scene = CommittedScene(history, world, limits)
    return [scene.render(camera, background=of.background).colour for camera in cameras]


def _sigmoid(values: NDArray[Any]) -> Float:
    return np.asarray(1 / (1 + np.exp(-np.asarray(values, np.float64))))


def _by_plyfile(file: Path) -> Found:
    from plyfile import PlyData

    vertex = PlyData.read(str(file))["vertex"]

    def column(*names: str) -> Float:
        return np.stack([np.asarray(vertex[name], np.float64) for name in names], axis=-1)

    return Found(
        column("x", "y", "z"),
        column("rot_1", "rot_2", "rot_3", "rot_0"),
        np.exp(column("scale_0", "scale_1", "scale_2")),
        0.5 + SH_DEGREE_0 * column("f_dc_0", "f_dc_1", "f_dc_2"),
        _sigmoid(vertex["opacity"]),
    )


def _by_layout(file: Path) -> Found:
    content = file.read_bytes()
    floats = np.frombuffer(content, "<f4").reshape(-1, 8)[:, :6].astype(np.float64)
    numbers = np.frombuffer(content, np.uint8).reshape(-1, 32)
    w, x, y, z = (numbers[:, 28:].T.astype(np.float64) - 128) / 128
    return Found(
        floats[:, :3], np.stack([x, y, z, w], axis=1), floats[:, 3:6], numbers[:, 24:27] / 255, numbers[:, 27] / 255
    )


def _by_gsply(file: Path) -> Found:
    import gsply

    data = gsply.read_spz(str(file))
    return Found(
        np.asarray(data.means, np.float64),
        np.roll(np.float64(data.quats), -1, axis=1),
        np.exp(np.float64(data.scales)),
        0.5 + SH_DEGREE_0 * np.float64(data.sh0).reshape(-1, 3),
        _sigmoid(data.opacities).reshape(-1),
    )


def _by_pygltflib(file: Path) -> Found:
    """Returns the Gaussians of all nodes, at the end of the animation if there is one."""
    document, values = open_gltf(file)
    ends: dict[tuple[int, str], Float] = {}
    for animation in document.animations:
        for channel in animation.channels:
            ends[channel.target.node, channel.target.path] = values(animation.samplers[channel.sampler].output)[-1]
    gaussians = []
    for number, node in enumerate(document.nodes):
        has = vars(document.meshes[node.mesh].primitives[0].attributes)
        turn = Rotation.from_quat(ends.get((number, "rotation"), np.array([0.0, 0, 0, 1])))
        shift = ends.get((number, "translation"), np.zeros(3))
        gaussians.append(
            (
                turn.apply(values(has["POSITION"])) + shift,
                (turn * Rotation.from_quat(values(has[f"{SPLAT}:ROTATION"]))).as_quat(),
                values(has[f"{SPLAT}:SCALE"]),
                0.5 + SH_DEGREE_0 * values(has[f"{SPLAT}:SH_DEGREE_0_COEF_0"]),
                values(has[f"{SPLAT}:OPACITY"]),
            )
        )
    return Found(*(np.ascontiguousarray(np.concatenate(arrays)) for arrays in zip(*gaussians, strict=True)))


def _by_pxr(file: Path) -> Found:
    from pxr import Usd, UsdVol

    stage = Usd.Stage.Open(str(file))
    prim = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/World/Gaussians"))
    code = stage.GetStartTimeCode()
    degree = prim.GetRadianceSphericalHarmonicsDegreeAttr().Get()
    harmonics = np.array(prim.GetRadianceSphericalHarmonicsCoefficientsAttr().Get(code), np.float64)
    quaternions = prim.GetOrientationsAttr().Get(code)
    return Found(
        np.array(prim.GetPositionsAttr().Get(code), np.float64),
        np.array([[*q.GetImaginary(), q.GetReal()] for q in quaternions], np.float64),
        np.array(prim.GetScalesAttr().Get(code), np.float64),
        0.5 + SH_DEGREE_0 * harmonics.reshape(-1, (degree + 1) ** 2, 3)[:, 0],
        np.array(prim.GetOpacitiesAttr().Get(code), np.float64),
    )


READERS: Mapping[str, tuple[str, Callable[[Path], Found], bool]] = {
    "ply": ("plyfile", _by_plyfile, False),
    "splat": ("numpy, by the layout", _by_layout, False),
    "spz": ("gsply", _by_gsply, True),
    "spz4": ("gsply", _by_gsply, True),
    "glb": ("pygltflib", _by_pygltflib, True),
    "glb-parts": ("pygltflib", _by_pygltflib, True),
    "usd": ("pxr", _by_pxr, True),
}
"""Maps each format to the name of its reader, the reader, and whether the file's y axis points up."""
