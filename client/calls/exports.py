"""Calls for exports: multi-frame files in third-party formats, which the service writes in the background."""

from __future__ import annotations

from collections.abc import Sequence

from client.calls.call import Call, body, json_reader, nothing, path
from client.wire.exports import ExportFormat, ExportList, ExportModel, ExportRequest


def begin_export(
    id: str,
    format: ExportFormat,
    first: int | None = None,
    last: int | None = None,
    ids: Sequence[int] | None = None,
) -> Call[ExportModel]:
    """Starts a background export of committed frames to a file on the service; `export` reports its progress.

    Args:
        id: scene id.
        format: format name from docs/exports.md.
        first, last: first and last frame, inclusive; None for the first or last committed frame.
        ids: ids of the Gaussians to export in the `tracks` format; None for all moving Gaussians.

    Raises:
        Conflict: no frame is committed, or the scene already has the maximum number of exports.
        Busy: the export queue is full.

    >>> begun = client.begin_export(scene, "ply", first=1)
    >>> begun.frames, begun.format
    (2, 'ply')
    >>> client.delete_export(scene, begun.id)
    """
    given = {"format": format, "first": first, "last": last, "ids": None if ids is None else list(ids)}
    request = ExportRequest.model_validate({name: value for name, value in given.items() if value is not None})
    return Call("POST", path(id, "exports"), json_reader(ExportModel), repeatable=False, arguments=body(request))


def exports(id: str) -> Call[ExportList]:
    """Lists the exports of a scene, oldest first.

    >>> begun = client.begin_export(scene, "tracks")
    >>> begun.id in [export.id for export in client.exports(scene).exports]
    True
    >>> client.delete_export(scene, begun.id)
    """
    return Call("GET", path(id, "exports"), json_reader(ExportList))


def export(id: str, export_id: str) -> Call[ExportModel]:
    """Returns the state of an export.

    >>> begun = client.begin_export(scene, "splat", first=0, last=1)
    >>> while (found := client.export(scene, begun.id)).state in ("waiting", "running"):
    ...     time.sleep(0.05)
    >>> found.state, found.done, found.error
    (<ExportState.DONE: 'done'>, 2, None)
    >>> client.delete_export(scene, begun.id)
    """
    return Call("GET", path(id, "exports", export_id), json_reader(ExportModel))


def export_file(id: str, export_id: str, begin: int = 0, count: int | None = None) -> Call[bytes]:
    """Returns the file of a finished export, or a byte range of it, so that large files can be read in chunks.

    Args:
        id: scene id.
        export_id: export id.
        begin: offset of the first byte.
        count: number of bytes; None to read to the end.

    Raises:
        Conflict: the export is not finished.
        NotFound: the file has been removed.

    >>> begun = client.begin_export(scene, "ply")
    >>> while not client.export(scene, begun.id).file:
    ...     time.sleep(0.05)
    >>> client.export_file(scene, begun.id, 0, 2)
    b'PK'
    >>> client.delete_export(scene, begun.id)
    """
    end = "" if count is None else str(begin + count - 1)
    arguments = {"headers": {"Range": f"bytes={begin}-{end}"}} if begin or count is not None else {}
    return Call("GET", path(id, "exports", export_id, "file"), lambda response: response.content, arguments=arguments)


def delete_export(id: str, export_id: str) -> Call[None]:
    """Cancels a queued or running export, or removes a finished one with its file.

    >>> begun = client.begin_export(scene, "ply")
    >>> while not client.export(scene, begun.id).file:
    ...     time.sleep(0.05)
    >>> client.delete_export(scene, begun.id)
    >>> begun.id in [export.id for export in client.exports(scene).exports]
    False
    """
    return Call("DELETE", path(id, "exports", export_id), nothing)
