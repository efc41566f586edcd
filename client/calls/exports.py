"""Calls on exports: files of many frames in the formats of other tools, which the service makes in the background."""

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
    """Has the service write committed frames to a file, in the background; `export` reports its progress.

    Args:
        id: of the scene.
        format: a name of docs/exports.md.
        first, last: frames, both counted in; None: the first and the last that are committed.
        ids: Gaussians of format `tracks`; None: all that move.

    Raises:
        Conflict: no frame is committed, or the scene has as many exports as it may.
        Busy: as many exports wait as may.

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
    """Reads the state of an export.

    >>> begun = client.begin_export(scene, "splat", first=0, last=1)
    >>> while (found := client.export(scene, begun.id)).state in ("waiting", "running"):
    ...     time.sleep(0.05)
    >>> found.state, found.done, found.error
    (<ExportState.DONE: 'done'>, 2, None)
    >>> client.delete_export(scene, begun.id)
    """
    return Call("GET", path(id, "exports", export_id), json_reader(ExportModel))


def export_file(id: str, export_id: str, begin: int = 0, count: int | None = None) -> Call[bytes]:
    """Reads the file of an export that is done, or so many bytes of it: a large one comes piece by piece.

    Args:
        id: of the scene. export_id: of the export.
        begin, count: bytes; None: to the end.

    Raises:
        Conflict: it is not done. NotFound: its file is removed.

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
    """Cancels an export that waits or runs; removes one that is over, with its file.

    >>> begun = client.begin_export(scene, "ply")
    >>> while not client.export(scene, begun.id).file:
    ...     time.sleep(0.05)
    >>> client.delete_export(scene, begun.id)
    >>> begun.id in [export.id for export in client.exports(scene).exports]
    False
    """
    return Call("DELETE", path(id, "exports", export_id), nothing)
