from __future__ import annotations

import json

import pytest

from client.wire.framing import MAX_HEAD, PREFIX, FramingError, frame_chunks, head_length, parse_head

IMAGES = {"c0": b"abc", "c1": b""}


def parse_frame(data):
    """The header of a frame, and the bytes of its files."""
    at = PREFIX.size + head_length(data)
    head = parse_head(data[PREFIX.size : at])
    pieces = []
    for file in head.files:
        pieces.append(data[at : at + file.size])
        at += file.size
    return head, pieces


def test_a_frame_comes_back_as_it_was_sent():
    data = b"".join(frame_chunks(7, IMAGES, {"c0": b"mm"}, 0.25, part=True))
    head, pieces = parse_frame(data)
    assert (head.index, head.time, head.single_camera) == (7, 0.25, True)
    assert [(file.camera, file.kind, bytes(piece)) for file, piece in zip(head.files, pieces, strict=True)] == [
        ("c0", "image", b"abc"),
        ("c1", "image", b""),
        ("c0", "mask", b"mm"),
    ]


def test_files_are_not_copied_when_sent():
    chunks = frame_chunks(0, IMAGES)
    assert chunks[1] is IMAGES["c0"]


def test_every_cut_of_the_header_is_refused():
    data = frame_chunks(7, IMAGES, time=0.25)[0]
    for length in range(len(data)):
        with pytest.raises(FramingError):
            parse_frame(data[:length])


def framed(head) -> bytes:
    text = json.dumps(head).encode()
    return PREFIX.pack(b"S4DF", len(text)) + text


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (b"PK\3\4aaaaaaaa", "S4DF"),
        (PREFIX.pack(b"S4DF", MAX_HEAD + 1), "at most"),
        (framed([]), "head"),
        (framed({"index": -1, "files": [{"camera": "a", "size": 0}]}), "header field index"),
        (framed({"index": 0, "files": []}), "header field files"),
        (framed({"index": 0, "files": [{"camera": "../a", "size": 0}]}), "header field files.0.camera"),
        (framed({"index": 0, "files": [{"camera": "a", "size": -1}]}), "header field files.0.size"),
        (framed({"index": 0, "time": float("nan"), "files": [{"camera": "a", "size": 0}]}), "invalid time: .* not nan"),
        (framed({"index": 0, "files": [{"camera": "a", "size": 0}], "more": 1}), "header field more"),
    ],
)
def test_a_head_that_is_none_is_refused_by_name(data, match):
    with pytest.raises(FramingError, match=match):
        parse_frame(data)
