"""Route for the initial point cloud."""

from __future__ import annotations

import asyncio
import hashlib
import io
import zipfile
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Query, Request
from numpy.typing import NDArray

from client.wire import PointsReceipt
from scas4d_core.rig_checks import RigError, check_points, rig_warnings
from scas4d_core.storage.npz import write_npz
from server.problems import Problem, count_noun, rig_problem
from server.routes.access import AllScenes, TheScene
from server.storage.disk import full_disk, no_room
from server.storage.points import points_sha256

MOST_POINTS = 2_000_000
"""Maximum number of points of an initial cloud.

This is 20 times the maximum number of Gaussians of a scene, and takes 100 MB to validate.
"""

router = APIRouter(prefix="/v1/scenes", tags=["scenes"])

BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {"application/vnd.numpy.npz": {"schema": {"type": "string", "format": "binary"}}},
    }
}


@router.put("/{id}/points", openapi_extra=BODY)
async def put(
    scene: TheScene,
    scenes: AllScenes,
    request: Request,
    reconstruction: Annotated[
        int | None,
        Query(
            ge=0,
            description="Number of the reconstruction: the current one (default), or the next one before it starts.",
        ),
    ] = None,
) -> PointsReceipt:
    """Accepts the point cloud that initializes frame 0; it must be uploaded before frame 0.

    The body is an npz with `positions` [P, 3] in the rig's world frame and units, and `colours` [P, 3] in [0, 1].
    `foreground` [P] in [0, 1] is optional. Alternatively, the npz contains `data` [P, 6 or 7] with these as columns,
    like the `init_pt_cld.npz` of Dynamic3DGaussians. Uploading the same body again returns the same response. To
    restart a reconstruction from new points, upload them with `reconstruction=n` before `PUT …/reconstructions/{n}`.
    """
    body = await request.body()
    sha256 = hashlib.sha256(body).hexdigest()
    arrays = await asyncio.to_thread(read_points, body, MOST_POINTS)
    try:
        await asyncio.to_thread(check_points, scene.rig, arrays["positions"])
    except RigError as error:
        raise rig_problem(error) from None
    own = scene.ledger.reconstruction
    number = own if reconstruction is None else reconstruction
    receipt = PointsReceipt(points=len(arrays["positions"]), sha256=sha256, reconstruction=number)
    async with scene.log.lock:
        scenes.check_current(scene)
        file = scene.spec.folder.points if number == own else scene.spec.folder.points_of(number)
        if number in (own, own + 1) and await asyncio.to_thread(points_sha256, file) == sha256:
            return receipt
        check_number(number, own, scene.next_frame)
        stored = {**arrays, "sha256": np.frombuffer(bytes.fromhex(sha256), np.uint8)}
        try:
            await asyncio.to_thread(write_npz, file, stored)
        except Exception as error:
            if no_room(error):
                raise full_disk(error) from None
            raise
        if number == own:
            scene.points_sha256 = sha256
            given = scene.rig, scene.spec.settings.scene, arrays["positions"]
            scene.warnings = await asyncio.to_thread(rig_warnings, *given)
    return receipt


def check_number(number: int, own: int, next_frame: int) -> None:
    """Checks that the points are for the current reconstruction, if it has not started, or for the next one.

    Raises:
        Problem: 409 if they are for any other reconstruction.
    """
    if number == own + 1 or (number == own == 0 and next_frame == 0):
        return
    fault = f"reconstruction {number} is not the next one (the current one is {own})"
    if number <= own:
        fault = "this reconstruction has already started without these points"
    raise Problem(
        409,
        fault,
        field="points" if number <= own else "reconstruction",
        value=number,
        remedy=f"send them with ?reconstruction={own + 1}, then restart from them: PUT …/reconstructions/{own + 1}",
        expected=own + 1,
    )


def read_points(body: bytes, limit: int) -> dict[str, NDArray[Any]]:
    """Returns the validated arrays of an npz point cloud; sizes are checked before unpacking; nothing is unpickled."""
    shapes = {"positions": (np.float64, 3), "colours": (np.float32, 3), "foreground": (np.float32, 0)}
    try:
        with zipfile.ZipFile(io.BytesIO(body)) as archive:
            unpacked = sum(member.file_size for member in archive.infolist())
        if unpacked > 64 * limit:
            raise Problem(
                413,
                f"the point cloud is too large: {unpacked} bytes after decompression",
                field="points",
                value=unpacked,
                remedy=f"send at most {limit} points",
            )
        with np.load(io.BytesIO(body), allow_pickle=False) as file:
            arrays = {name: np.asarray(file[name]) for name in file.files if name in (*shapes, "data")}
    except (zipfile.BadZipFile, ValueError, OSError, EOFError, KeyError, RuntimeError, NotImplementedError) as error:
        raise Problem(
            422,
            f"cannot read the body as an npz file (pickled objects are not allowed): {error}",
            field="points",
            value=count_noun(len(body), "byte"),
            remedy="send the output of numpy.savez(positions=…, colours=…, foreground=…) with numeric arrays",
        ) from None
    if (data := arrays.pop("data", None)) is not None and "positions" not in arrays:
        arrays = columns_of(data)
    count = len(arrays["positions"]) if "positions" in arrays and arrays["positions"].ndim else 0
    for name, (kind, columns) in shapes.items():
        if name not in arrays and name == "foreground":
            continue
        wanted = (count, columns) if columns else (count,)
        array = arrays.get(name)
        if array is None or array.shape != wanted or not 1 <= count <= limit or array.dtype.kind not in "fiu":
            given = "missing" if array is None else f"{array.dtype} {array.shape}"
            raise Problem(
                422,
                f"invalid {name}: {given}",
                field=name,
                value=given,
                remedy=f"use a numeric array of shape {'[P, 3]' if columns else '[P]'}, 1 ≤ P ≤ {limit}",
            )
        arrays[name] = array.astype(kind)
        if not np.isfinite(arrays[name]).all():
            raise Problem(
                422, f"{name} contains NaN or infinity", field=name, value="NaN", remedy="use finite numbers only"
            )
        if name != "positions" and (arrays[name].min() < 0 or arrays[name].max() > 1):
            top = f"{arrays[name].min():g} … {arrays[name].max():g}"
            raise Problem(
                422,
                f"{name} must be in 0 … 1, got values in {top}",
                field=name,
                value=top,
                remedy="scale the values to 0 … 1",
            )
    return arrays


def columns_of(data: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Splits the array [P, 7] of an `init_pt_cld.npz` into x y z, r g b and foreground; foreground may be missing.

    Raises:
        Problem: 422 if the array has a different shape.
    """
    if data.ndim != 2 or data.shape[1] not in (6, 7):
        raise Problem(
            422,
            f"data must be an array of shape [P, 6] or [P, 7], got {data.dtype} {data.shape}",
            field="data",
            value=f"{data.dtype} {data.shape}",
            remedy="use the columns x y z, r g b and, optionally, foreground; or send positions and colours instead",
        )
    columns = {"positions": data[:, :3], "colours": data[:, 3:6]}
    return columns | ({"foreground": data[:, 6]} if data.shape[1] == 7 else {})
