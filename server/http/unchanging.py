"""Answers that stay as they are: with a tag, a range of bytes where one is asked for, and a name for the file."""

from __future__ import annotations

import asyncio
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import BinaryIO
from urllib.parse import quote

from blake3 import blake3
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse

from server.http.middleware import HEAD
from server.problems import Problem

RANGE = re.compile(r"bytes=([0-9]{0,18})-([0-9]{0,18})")
TAG_BYTES = 16
PIECE = 256 * 1024
"""Bytes of a file that are read at once."""
KEEP = "private, no-cache"
"""Caches keep an answer, and ask before each use whether it still holds: a damaged state may be made again."""


def disposition(name: str, *, inline: bool = False) -> str:
    """Returns a Content-Disposition (RFC 6266) with the name of the file, whatever characters it has.

    >>> disposition("front.png", inline=True)
    'inline; filename="front.png"'
    """
    kind = "inline" if inline else "attachment"
    plain = "".join(c if " " <= c <= "~" and c not in '"\\%/' else "_" for c in name)
    other = "" if plain == name else f"; filename*=UTF-8''{quote(name, safe='')}"
    return f'{kind}; filename="{plain}"{other}'


def unchanging(
    request: Request,
    body: bytes | memoryview,
    *,
    media_type: str,
    name: str,
    inline: bool = False,
    headers: Mapping[str, str] | None = None,
) -> Response:
    """Answers with bytes that stay as they are for this address.

    304 for `If-None-Match` with the tag, 206 for one range of bytes (`If-Range` must have the tag); several ranges, and
    units other than bytes, get the whole (RFC 9110, 13.1 and 14.2).

    Args:
        request: with the conditions. body: the whole of it. media_type: of it.
        name: of the file, for those who save it. inline: browsers show it. headers: others.

    Raises:
        Problem: 416, the range begins behind the end.
    """
    tag = f'"{blake3(body).hexdigest(TAG_BYTES)}"'
    kept = {
        **(headers or {}),
        "ETag": tag,
        "Cache-Control": KEEP,
        "Accept-Ranges": "bytes",
        "Content-Disposition": disposition(name, inline=inline),
    }
    if is_known(request, tag):
        return Response(status_code=304, headers=kept)
    wanted = _range(request, tag, len(body))
    if wanted is None:
        return Response(bytes(body), media_type=media_type, headers=kept)
    start, end = wanted
    kept["Content-Range"] = f"bytes {start}-{end - 1}/{len(body)}"
    return Response(bytes(body[start:end]), 206, kept, media_type)


async def unchanging_file(request: Request, path: Path, *, tag: str, media_type: str, name: str) -> Response:
    """Answers with a file that stays as it is, as `unchanging` does, and holds a piece of it in memory.

    Args:
        request: with the conditions. path: of the file. tag: without quotes, of its bytes. media_type: of it.
        name: of the file, for those who save it.

    Raises:
        Problem: 416, the range begins behind the end. FileNotFoundError: there is no such file.
    """
    opened = await asyncio.to_thread(path.open, "rb")
    kept = {
        "ETag": f'"{tag}"',
        "Cache-Control": KEEP,
        "Accept-Ranges": "bytes",
        "Content-Disposition": disposition(name),
    }
    try:
        if is_known(request, kept["ETag"]):
            opened.close()
            return Response(status_code=304, headers=kept)
        size = os.fstat(opened.fileno()).st_size
        wanted = _range(request, kept["ETag"], size)
    except BaseException:
        opened.close()
        raise
    start, end = wanted or (0, size)
    kept["Content-Length"] = str(end - start)
    if wanted is not None:
        kept["Content-Range"] = f"bytes {start}-{end - 1}/{size}"
    status = 200 if wanted is None else 206
    if HEAD in request.scope:
        opened.close()
        return Response(None, status, kept, media_type)
    return StreamingResponse(_pieces(opened, start, end), status, kept, media_type)


def _pieces(opened: BinaryIO, start: int, end: int) -> Iterator[bytes]:
    """Reads an open file from one byte to another, and closes it; in threads, as Starlette runs it."""
    with opened:
        opened.seek(start)
        while start < end and (piece := opened.read(min(PIECE, end - start))):
            start += len(piece)
            yield piece


def is_known(request: Request, tag: str) -> bool:
    """True where `If-None-Match` has the tag, weak or strong."""
    given = request.headers.get("if-none-match")
    if given is None or request.method not in ("GET", "HEAD"):
        return False
    return given.strip() == "*" or tag.removeprefix("W/") in (
        one.strip().removeprefix("W/") for one in given.split(",")
    )


def _range(request: Request, tag: str, size: int) -> tuple[int, int] | None:
    """Returns begin and end of the range that is asked for; None: the whole.

    Raises:
        Problem: 416.
    """
    given = request.headers.get("range")
    if given is None or request.headers.get("if-range", tag) != tag:
        return None
    match = RANGE.fullmatch(given.strip())
    if match is None or match.groups() == ("", ""):
        return None
    first, last = match.groups()
    if not first:
        start, end = max(0, size - int(last)), size
    else:
        start, end = int(first), min(size, int(last) + 1) if last else size
        if last and int(last) < int(first):
            return None
    if start >= size or start >= end:
        raise Problem(
            416,
            f"there are {size} bytes",
            field="Range",
            value=given,
            remedy="ask for a range that begins before the end, or for the whole without Range",
            headers={"Content-Range": f"bytes */{size}"},
        )
    return start, end
