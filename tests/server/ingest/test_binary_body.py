"""The faults of a binary body that docs/api.md lists, each with the status and the field that stand there."""

from __future__ import annotations

import asyncio
import json
from itertools import pairwise

import httpx
import pytest
from blake3 import blake3
from running import picture, pictures, problem
from sending import FRAMED, create, finished, framed, put_framed, status
from waiting import HANG_S

from client.wire.framing import MAX_HEAD, PREFIX
from server.ingest.receive import BodyReader, FrameReceiver, read_files, read_head


def with_head(head, *files):
    text = json.dumps(head).encode()
    return PREFIX.pack(b"S4DF", len(text)) + text + b"".join(files)


def head(*files, **more):
    return {"index": 1, "files": [{"camera": camera, "size": size} for camera, size in files], **more}


C0, C1 = pictures().values()
BOTH = (("c0", len(C0)), ("c1", len(C1)))
LARGEST = 24 * 16 * 5 + 1_000_000
"""Bytes of a file of the small rig."""

FAULTS = {
    "another beginning": (b"S4DS" + framed(1)[4:], 422, "body"),
    "an early end": (framed(1)[:-1], 422, "body"),
    "a byte behind": (framed(1) + b"\0", 422, "body"),
    "a long head": (PREFIX.pack(b"S4DF", MAX_HEAD + 1) + b"{}", 422, "body"),
    "no JSON": (PREFIX.pack(b"S4DF", 2) + b"{,", 422, "body"),
    "no files": (with_head({"index": 1}), 422, "body"),
    "an unknown member": (with_head(head(*BOTH, frame=1), C0, C1), 422, "body"),
    "another index": (framed(2), 422, "head.index"),
    "a time that is too early": (with_head(head(*BOTH, time=-1e300), C0, C1), 422, "time"),
    "another camera": (framed(1, {**pictures(), "c2": picture()}), 422, "c2"),
    "a file twice": (with_head(head(*BOTH, BOTH[0]), C0, C1, C0), 422, "c0"),
    "no picture of a camera": (framed(1, {"c0": picture()}), 422, "c1"),
    "no mask of a camera": (framed(1, masks={"c0": picture(mode="L")}), 422, "mask.c1"),
    "a damaged picture": (framed(1, {"c0": picture()[:-9], "c1": picture()}), 422, "c0"),
    "another size": (framed(1, {"c0": picture(size=(16, 24)), "c1": picture()}), 422, "c0"),
    "a mask as JPEG": (
        framed(1, masks={name: picture(mode="L", format="JPEG") for name in pictures()}),
        422,
        "mask.c0",
    ),
    "too large a file": (with_head(head(("c0", LARGEST + 1), BOTH[1]), bytes(LARGEST + 1), C1), 413, "c0"),
    "too large a body": (with_head(head(*BOTH), bytes(2_000_001)), 413, "Content-Length"),
}


@pytest.fixture(scope="module")
def begun(service):
    """A scene that has its first frame, at 0 s; it takes none of the others."""
    with httpx.Client(base_url=service.url, timeout=HANG_S) as http:
        id = create(http)
        assert put_framed(http, id, 0).status_code == 202
        finished(http, id, 0)
        yield id
        assert status(http, id)["next_frame"] == 1
        http.delete(f"/v1/scenes/{id}")


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_told_with_its_field(http, begun, fault):
    body, expected, field = FAULTS[fault]
    document = problem(http.put(f"/v1/scenes/{begun}/frames/1", content=body, headers=FRAMED), expected)
    assert document["field"] == field
    assert document["remedy"]


def test_the_body_of_one_camera_holds_that_camera(http, begun):
    url = f"/v1/scenes/{begun}/frames/1/cameras/c0"
    for images in (pictures(), {"c1": picture()}):
        assert problem(http.put(url, content=framed(1, images), headers=FRAMED), 422)["field"] == "head.files"


@pytest.mark.parametrize("cuts", [(1,), (7,), (8,), (9,), (50,), (100, 101), (300,), range(1, 300)], ids=str)
def test_a_body_is_read_in_whatever_pieces_it_arrives(tmp_path, cuts):
    body = framed(0)

    async def pieces():
        for begin, end in pairwise((0, *cuts, len(body))):
            yield body[begin:end]

    async def read():
        reader = BodyReader(pieces())
        head = await read_head(reader)
        receiving = FrameReceiver(tmp_path, head, None, lambda file, data: None, keep=False)
        await read_files(reader, receiving, ends_body=True)
        return head, await receiving.finish()

    head, received = asyncio.run(read())
    assert [(file.camera, file.size) for file in head.files] == list(BOTH)
    expected = {name: {"image": blake3(data).hexdigest()} for name, data in pictures().items()}
    assert received.hashes == expected


def test_the_order_of_files_is_free_and_optional_members_may_be_left_out(http, make):
    id = make()
    mask = picture(mode="L")
    files = [("c1", "mask", mask), ("c0", "image", C0), ("c0", "mask", mask), ("c1", "image", C1)]
    listed = [{"camera": camera, "kind": kind, "size": len(data)} for camera, kind, data in files]
    body = with_head({"index": 0, "files": listed}, *(data for _, _, data in files))
    first = http.put(f"/v1/scenes/{id}/frames/0", content=body, headers=FRAMED)
    again = http.put(f"/v1/scenes/{id}/frames/0", content=iter([body[:50], body[50:]]), headers=FRAMED)  # in chunks
    assert (first.status_code, again.status_code) == (202, 202), again.text
    assert first.json() == again.json()
    ordered = http.put(f"/v1/scenes/{id}/frames/0", content=framed(0, masks={"c0": mask, "c1": mask}), headers=FRAMED)
    assert ordered.json() == first.json()
