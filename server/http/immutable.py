"""Responses with immutable content, including entity tags, byte ranges and file names."""

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
"""Block size in bytes for reading a file."""
KEEP = "private, no-cache"
"""Cache-Control value; caches must revalidate a stored response, because a damaged state may be recomputed."""


def content_disposition(name: str, *, inline: bool = False) -> str:
    """Returns the value of a Content-Disposition header (RFC 6266) for a file name with arbitrary characters.

    >>> content_disposition("front.png", inline=True)
    'inline; filename="front.png"'
    """
    kind = "inline" if inline else "attachment"
    plain = "".join(c if " " <= c <= "~" and c not in '"\\%/' else "_" for c in name)
    other = "" if plain == name else f"; filename*=UTF-8''{quote(name, safe='')}"
    return f'{kind}; filename="{plain}"{other}'


def immutable_response(
    request: Request,
    body: bytes | memoryview,
    *,
    media_type: str,
    name: str,
    inline: bool = False,
    headers: Mapping[str, str] | None = None,
) -> Response:
    """Returns a response whose body never changes for this URL.

    The status is 304 if `If-None-Match` contains the tag, and 206 for a single byte range (`If-Range`, if present, must
    match the tag). Requests for multiple ranges or other units get the whole body (RFC 9110, 13.1 and 14.2).

    Args:
        request: HTTP request with its conditional headers.
        body: complete body.
        media_type: media type of the body.
        name: file name for clients that save the body.
        inline: whether browsers display the body instead of saving it.
        headers: additional response headers.

    Raises:
        Problem: 416 if the range starts at or after the end of the body.
    """
    tag = f'"{blake3(body).hexdigest(TAG_BYTES)}"'
    kept = {
        **(headers or {}),
        "ETag": tag,
        "Cache-Control": KEEP,
        "Accept-Ranges": "bytes",
        "Content-Disposition": content_disposition(name, inline=inline),
    }
    if matches_etag(request, tag):
        return Response(status_code=304, headers=kept)
    wanted = _range(request, tag, len(body))
    if wanted is None:
        return Response(bytes(body), media_type=media_type, headers=kept)
    start, end = wanted
    kept["Content-Range"] = f"bytes {start}-{end - 1}/{len(body)}"
    return Response(bytes(body[start:end]), 206, kept, media_type)


async def immutable_file_response(request: Request, path: Path, *, tag: str, media_type: str, name: str) -> Response:
    """Returns a response that streams an immutable file in blocks.

    Conditional requests and byte ranges are handled as in `immutable_response`.

    Args:
        request: HTTP request with its conditional headers.
        path: path of the file.
        tag: entity tag of the file's contents, without quotes.
        media_type: media type of the file.
        name: file name for clients that save the file.

    Raises:
        Problem: 416 if the range starts at or after the end of the file.
        FileNotFoundError: the file does not exist.
    """
    opened = await asyncio.to_thread(path.open, "rb")
    kept = {
        "ETag": f'"{tag}"',
        "Cache-Control": KEEP,
        "Accept-Ranges": "bytes",
        "Content-Disposition": content_disposition(name),
    }
    try:
        if matches_etag(request, kept["ETag"]):
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
    """Yields the bytes from `start` to `end` of an open file in pieces, then closes the file.

    Starlette runs the iterator in threads.
    """
    with opened:
        opened.seek(start)
        while start < end and (piece := opened.read(min(PIECE, end - start))):
            start += len(piece)
            yield piece


def matches_etag(request: Request, tag: str) -> bool:
    """Returns whether `If-None-Match` contains the tag, using weak comparison."""
    given = request.headers.get("if-none-match")
    if given is None or request.method not in ("GET", "HEAD"):
        return False
    return given.strip() == "*" or tag.removeprefix("W/") in (
        one.strip().removeprefix("W/") for one in given.split(",")
    )


def _range(request: Request, tag: str, size: int) -> tuple[int, int] | None:
    """Returns the start and end of the requested byte range, or None for the whole body.

    Raises:
        Problem: 416 if the range is not satisfiable.
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
            f"the range is not within the {size} bytes of the body",
            field="Range",
            value=given,
            remedy="request a range that starts before the end, or omit Range to get the whole body",
            headers={"Content-Range": f"bytes */{size}"},
        )
    return start, end
