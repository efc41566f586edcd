"""Routes for exports: files with many frames in third-party formats, written in the background."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Path, Request, Response

from client.wire import WITH_IDS, ExportList, ExportModel, ExportRequest, ExportState
from server.http.immutable import immutable_file_response
from server.problems import Problem
from server.routes.access import AllExports, SceneId, TheRecord
from server.scene.exports import MEDIA_TYPES

router = APIRouter(prefix="/v1/scenes", tags=["exports"])

ExportId = Annotated[str, Path(max_length=64, description="Id of the export.")]
KINDS = (*MEDIA_TYPES.values(), "application/octet-stream")
FILE: dict[int | str, dict[str, Any]] = {
    200: {
        "content": {kind: {"schema": {"type": "string", "format": "binary"}} for kind in KINDS},
        "description": "Content of the file, or a range of its bytes (206).",
    }
}


@router.post("/{id}/exports", status_code=202)
async def begin(scene: TheRecord, exports: AllExports, request: ExportRequest, response: Response) -> ExportModel:
    """Starts an export of committed frames in the background; the `Location` header contains its URL.

    The service runs one export at a time, in a separate low-priority process, so that updates and views have priority.
    A scene can have up to 8 exports. Files are kept for one day, but not across restarts of the service.
    """
    if request.ids is not None and request.format not in WITH_IDS:
        raise Problem(
            422,
            f"format {request.format!r} does not support ids",
            field="ids",
            value=request.ids,
            remedy=f"omit ids, or use format {' or '.join(map(repr, WITH_IDS))}",
        )
    frames = scene.committed_range(request.first, request.last, "first")
    made = exports.begin(scene, request, frames).model()
    response.headers["Location"] = f"/v1/scenes/{scene.id}/exports/{made.id}"
    return made


@router.get("/{id}/exports")
async def listed(id: SceneId, exports: AllExports) -> ExportList:
    """Lists the exports of a scene, oldest first, without waking a sleeping scene."""
    return ExportList(exports=[export.model() for export in exports.of(id)])


@router.get("/{id}/exports/{export}")
async def get(id: SceneId, export: ExportId, exports: AllExports) -> ExportModel:
    """Returns the state of an export: the number of frames written, or the reason for its failure."""
    return exports.get(id, export).model()


@router.get("/{id}/exports/{export}/file", response_class=Response, responses=FILE)
async def file(id: SceneId, export: ExportId, exports: AllExports, request: Request) -> Response:
    """Returns the file of a finished export; numbered files are packed into one .zip file.

    `Range` and `If-None-Match` are supported.
    """
    file_export = exports.get(id, export)
    if file_export.state != ExportState.DONE:
        raise Problem(
            409,
            f"the export is {file_export.state.value}" + (f": {file_export.error}" if file_export.error else ""),
            field="export",
            value=export,
            remedy=f"wait until GET /v1/scenes/{id}/exports/{export} reports that it is done"
            if file_export.error is None
            else "start another export",
        )
    try:
        return await immutable_file_response(
            request, file_export.spec.file, tag=file_export.id, media_type=file_export.media_type, name=file_export.name
        )
    except FileNotFoundError:  # removed after the state was checked
        remedy = "start another export"
        raise Problem(404, "the export has been removed", field="export", value=export, remedy=remedy) from None


@router.delete("/{id}/exports/{export}", status_code=204)
async def remove(id: SceneId, export: ExportId, exports: AllExports) -> None:
    """Cancels a queued or running export, or removes a finished one with its file."""
    await exports.remove(id, export)
