"""Calls that render novel views of committed frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from numpy.typing import NDArray

from client.calls.call import Call, body, path, read_npz, read_picture, wire_camera
from client.wire import RenderRequest
from scas4d_core.cameras import Camera

Colour = tuple[float, float, float]


def render(
    id: str,
    camera: Camera | str,
    frame: int | None = None,
    *,
    kind: str = "colour",
    format: str = "png",
    background: Colour | None = None,
    width: int | None = None,
    parts: int | None = None,
) -> Call[NDArray[Any]]:
    """Renders a view and returns the image: [H, W, 3] uint8 for colour, otherwise [H, W].

    Args:
        id: scene id.
        camera: any camera in the rig's world frame, or the name of a camera in the rig.
        frame: index of a committed frame; None for the last one.
        kind: type of image: colour, depth, alpha or parts.
        format: transfer format: png, jpeg or webp.
        background: RGB in [0, 1]; None for the scene's background.
        width: image width in pixels; the camera is scaled to match. None for the camera's own width.
        parts: number of parts; None to choose it automatically.

    >>> client.render(scene, "c0").shape
    (16, 24, 3)
    >>> client.render(scene, rig.cameras[1], 0, kind="depth").shape
    (16, 24)
    """
    arguments = _request(camera, frame, [kind], format, background, width, parts)
    return Call("POST", path(id, "render"), read_picture, arguments=arguments)


def render_file(
    id: str,
    camera: Camera | str,
    frame: int | None = None,
    *,
    kind: str = "colour",
    format: str = "png",
    background: Colour | None = None,
    width: int | None = None,
    parts: int | None = None,
) -> Call[bytes]:
    """Renders a view and returns the encoded file; accepts the arguments of `render`, and every format of the service.

    >>> client.render_file(scene, "c0", format="jpeg")[:2].hex()
    'ffd8'
    """
    arguments = _request(camera, frame, [kind], format, background, width, parts)
    return Call("POST", path(id, "render"), lambda response: response.content, arguments=arguments)


def render_arrays(
    id: str,
    camera: Camera | str,
    frame: int | None = None,
    *,
    kinds: Sequence[str] = ("colour",),
    background: Colour | None = None,
    width: int | None = None,
    parts: int | None = None,
) -> Call[dict[str, NDArray[Any]]]:
    """Renders several image types of one view and returns the array of each, keyed by type.

    Colours are in [0, 1], and depth is measured along z in the rig's units. The other types are alpha and parts.

    >>> views = client.render_arrays(scene, "c0", kinds=["colour", "depth"])
    >>> views["colour"].shape, views["depth"].shape
    ((16, 24, 3), (16, 24))
    """
    arguments = _request(camera, frame, kinds, "npz", background, width, parts)
    return Call("POST", path(id, "render"), read_npz, arguments=arguments)


def _request(
    camera: Camera | str,
    frame: int | None,
    kinds: Sequence[str],
    format: str,
    background: Colour | None,
    width: int | None,
    parts: int | None,
) -> dict[str, Any]:
    asked = {
        "camera": wire_camera(camera),
        "frame": frame,
        "kinds": list(kinds),
        "format": format,
        "background": background,
        "width": width,
        "parts": parts,
    }
    return body(RenderRequest.model_validate({name: value for name, value in asked.items() if value is not None}))
