"""Reads the camera file of Agisoft Metashape (File > Export > Export Cameras, XML).

Each `sensor` has a `resolution` and a `calibration` with `f`, `cx`, `cy`, `b1`, `b2` (pixels), `k1` … `k4`, `p1`, `p2`.
Each `camera` has a camera-to-chunk `transform` [4, 4] with the axes x right, y down, z forward. The `transform` of the
chunk or of its component (`rotation`, `translation`, `scale`) leads to world coordinates. With x = X/Z, y = Y/Z and
r² = x² + y², the frame model is

    x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + p1 (r² + 2x²) + 2 p2 x y
    y' = y (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + p2 (r² + 2y²) + 2 p1 x y
    u = width/2 + cx + x' (f + b1) + y' b2,  v = height/2 + cy + y' f

where (0.5, 0.5) is the centre of the first pixel, so p1 and p2 are OpenCV's p2 and p1. In the fisheye model, x and y
are first multiplied by atan(r)/r. k4 of the frame model and b2 are not supported. Cameras that are disabled or have no
transform are left out, and a remark lists them.
(Agisoft Metashape Professional user manual, appendices "Camera models" and "Coordinate systems".)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from client.importers.calibration import Calibration, calibration_of_cameras, stem
from client.importers.formats.documents import number, read_xml, whole
from client.importers.formats.opencv_camera import numbers
from client.importers.lens import LensCamera, lens_camera
from scas4d_core.captures import CaptureError

Float = NDArray[np.float64]

SKEW = 1e-6
"""Largest b2, relative to f, that is treated as 0."""


@dataclass(frozen=True, eq=False)
class _Part:
    """Cameras with common coordinates: those of a chunk, or of one of its components."""

    name: str
    to_world: Float
    scale: float
    cameras: list[Element]


def is_metashape(root: Element) -> bool:
    """Returns whether an XML document has chunks."""
    return root.tag == "document" and root.find("chunk") is not None


def read_metashape(path: Path) -> Calibration:
    """Reads the rig from a camera file. Of several chunks or components, the one with the most cameras is read.

    Raises:
        CaptureError: if a field is missing or invalid. The message names the file, camera, field and remedy.
    """
    chunks = read_xml(path).findall("chunk")
    parts = [(part, chunk) for chunk in chunks for part in _parts(path, chunk)]
    if not parts:
        unposed = [_label(camera) for chunk in chunks for camera in chunk.iterfind("cameras//camera")]
        return calibration_of_cameras(path, [], unposed)
    part, chunk = max(parts, key=lambda pair: len(pair[0].cameras))
    sensors = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}
    cameras = [_camera(path, camera, sensors, part) for camera in part.cameras]
    left_out = [_label(camera) for camera in chunk.iterfind("cameras//camera") if not _posed(camera)]
    why = f"{path.name}: skipped cameras that are disabled or have no transform"
    remarks = []
    if len(parts) > 1:
        sizes = ", ".join(f"{one.name} with {len(one.cameras)} cameras" for one, _ in parts)
        remarks = [f"{path.name}: found {len(parts)} chunks or components ({sizes}); using {part.name}, the largest"]
    return calibration_of_cameras(path, cameras, left_out, why, remarks)


def _label(camera: Element) -> str:
    """Returns the name of a camera, which Metashape takes from the image, in some versions with its extension."""
    label = camera.get("label") or f"camera {camera.get('id')}"
    path = PurePosixPath(label)
    return label.removesuffix(path.suffix) if stem(path) != path.name else label


def _posed(camera: Element) -> bool:
    return camera.get("enabled", "true") not in ("false", "0") and camera.find("transform") is not None


def _parts(path: Path, chunk: Element) -> list[_Part]:
    posed = [camera for camera in chunk.iterfind("cameras//camera") if _posed(camera)]
    name = f"chunk {chunk.get('label', chunk.get('id', ''))!r}"
    if chunk.find("transform") is not None or chunk.find("components/component") is None:
        components = {camera.get("component_id") for camera in posed}
    else:
        components = {component.get("id") for component in chunk.iterfind("components/component")}
    parts = []
    for id in sorted(components, key=str):
        cameras = [camera for camera in posed if camera.get("component_id") == id]
        own = next((one for one in chunk.iterfind("components/component") if one.get("id") == id), None)
        transform = own.find("transform") if own is not None and own.find("transform") is not None else None
        transform = chunk.find("transform") if transform is None else transform
        if cameras:
            label = name if len(components) == 1 else f"{name}, component {id}"
            parts.append(_Part(label, *_to_world(f"{path}: {label}", transform), cameras))
    return parts


def _to_world(where: str, transform: Element | None) -> tuple[Float, float]:
    """Returns the rotation and translation [4, 4] and the scale from chunk to world coordinates."""
    matrix, scale = np.eye(4), 1.0
    if transform is None:
        return matrix, scale
    texts = {part.tag: (part.text or "").split() for part in transform}
    if "rotation" in texts:
        matrix[:3, :3] = numbers(where, "rotation", texts["rotation"], (9,)).reshape(3, 3)
    if "translation" in texts:
        matrix[:3, 3] = numbers(where, "translation", texts["translation"], (3,))
    if "scale" in texts:
        scale = float(numbers(where, "scale", texts["scale"], (1,))[0])
        if scale <= 0:
            raise CaptureError(f"{where}: scale must be positive; got {scale:g}")
    return matrix, scale


def _camera(path: Path, camera: Element, sensors: Mapping[str | None, Element], part: _Part) -> LensCamera:
    name = _label(camera)
    where = f"{path}: camera {name!r}"
    sensor = sensors.get(camera.get("sensor_id"))
    calibrations = [] if sensor is None else sensor.findall("calibration")
    if sensor is None or not calibrations:
        raise CaptureError(
            f"{where}: its sensor {camera.get('sensor_id')!r} has no calibration; align the cameras first"
        )
    lens = next((one for one in calibrations if one.get("class") == "adjusted"), calibrations[0])
    model = lens.get("type", sensor.get("type", "frame"))
    values = {value.tag: value.text for value in lens}
    if "f" not in values:
        raise CaptureError(f"{where}: its calibration has no f; export the cameras from Metashape 1.2 or later")
    given = {
        key: number(where, values, key, 0.0)
        for key in ("f", "cx", "cy", "b1", "b2", *(f"k{i}" for i in range(1, 5)), "p1", "p2")
    }
    given["f"] = number(where, values, "f")
    resolution = lens.find("resolution") if lens.find("resolution") is not None else sensor.find("resolution")
    attributes = {} if resolution is None else resolution.attrib
    width, height = whole(where, attributes, "width"), whole(where, attributes, "height")
    if model not in ("frame", "fisheye"):
        raise CaptureError(f"{where}: unsupported camera type {model!r}; calibrate as frame or fisheye")
    refused = ["b2"] if abs(given["b2"]) > SKEW * given["f"] else []
    refused += [key for key in (("k4",) if model == "frame" else ("p1", "p2")) if given[key]]
    if refused:
        raise CaptureError(
            f"{where}: {', '.join(f'{key} = {given[key]:g}' for key in refused)} is not supported with type {model}; "
            "optimize the cameras without it (Tools > Optimize Cameras)"
        )
    parameters = {
        "fx": given["f"] + given["b1"],
        "fy": given["f"],
        "cx": width / 2 + given["cx"],
        "cy": height / 2 + given["cy"],
        **{key: given[key] for key in ("k1", "k2", "k3")},
    }
    parameters |= {"k4": given["k4"]} if model == "fisheye" else {"p1": given["p2"], "p2": given["p1"]}
    kind = "OPENCV_FISHEYE" if model == "fisheye" else "OPENCV"
    to_chunk = numbers(where, "transform", (camera.findtext("transform") or "").split(), (16,)).reshape(4, 4)
    to_world = np.eye(4)
    to_world[:3, :3] = part.to_world[:3, :3] @ to_chunk[:3, :3]
    to_world[:3, 3] = part.to_world[:3, :3] @ to_chunk[:3, 3] * part.scale + part.to_world[:3, 3]
    try:
        pose = np.asarray(np.linalg.inv(to_world), np.float64)
    except np.linalg.LinAlgError as fault:
        raise CaptureError(f"{where}: transform cannot be inverted; export the cameras again") from fault
    if not any(parameters[key] for key in parameters if key[0] in "kp") and kind == "OPENCV":
        kind = "PINHOLE"
        parameters = {key: value for key, value in parameters.items() if key[0] not in "kp"}
    return lens_camera(name, kind, parameters, pose, (width, height), source=where)
