"""What HTTP gives every client: HEAD, compression, tags, ranges, names of files; and whether frames can be taken."""

from __future__ import annotations

import gzip
import shutil
from collections import namedtuple

import httpx
import pytest
from running import Running, fake_settings, picture, pictures, problem
from waiting import HANG_S

from client.sdk import Client
from server.http.immutable import content_disposition

NAME = next(iter(pictures()))


@pytest.fixture
def committed(sdk, scene):
    sdk.put_frame(scene, 0, pictures(5))
    sdk.wait(scene, 0)
    return scene


@pytest.fixture
def address(committed):
    return f"/v1/scenes/{committed}/frames/0"


def test_head_is_get_without_the_body(http, committed, address):
    for path in (
        "/health/live",
        "/v1/scenes",
        f"{address}/splat.ply",
        f"/v1/scenes/{committed}/render",
        "/viewer/main.js",
    ):
        whole, head = http.get(path), http.head(path)
        assert (head.status_code, head.content) == (200, b""), path
        assert head.headers["content-type"] == whole.headers["content-type"]
        assert head.headers.get("content-length") == whole.headers.get("content-length")
    assert http.head("/v1/scenes/nowhere").status_code == 404
    assert http.head("/v1/tickets").status_code == 405


def test_json_is_compressed_for_those_who_accept_it_and_pictures_are_not(http, committed, address):
    with httpx.Client(base_url=http.base_url, timeout=HANG_S) as client:
        request = client.build_request("GET", "/openapi.json", headers={"Accept-Encoding": "gzip"})
        answer = client.send(request, stream=True)
        raw = b"".join(answer.iter_raw())
        assert answer.headers["content-encoding"] == "gzip"
        assert "accept-encoding" in answer.headers["vary"].lower()
        plain = client.get("/openapi.json", headers={"Accept-Encoding": "identity"})
        assert "content-encoding" not in plain.headers
        assert gzip.decompress(raw) == plain.content
        assert len(raw) < len(plain.content) / 4
        for path in (f"{address}/cameras/{NAME}", f"/v1/scenes/{committed}/render", f"{address}/splat.ply"):
            assert "content-encoding" not in client.get(path).headers, path


def test_a_picture_comes_back_as_it_was_sent(http, sdk, committed, address):
    sent = pictures(5)
    for name, data in sent.items():
        assert sdk.picture(committed, 0, name) == data
    answer = http.get(f"{address}/cameras/{NAME}")
    assert answer.headers["content-type"].startswith("image/")
    assert answer.headers["content-disposition"].startswith(f'inline; filename="{committed[:8]}-000000-{NAME}.')
    for path, field in (
        (f"{address}/cameras/nobody", "c"),
        (f"{address}/cameras/{NAME}?kind=mask", "c"),
        (f"/v1/scenes/{committed}/frames/7/cameras/{NAME}", "n"),
    ):
        assert problem(http.get(path), 404)["field"] == field
    sdk.edit_scene(committed, keep_frames={"last": 1})
    for index in (1, 2):
        sdk.put_frame(committed, index, sent)
    sdk.wait(committed, 2)
    assert "no longer stored" in problem(http.get(f"{address}/cameras/{NAME}"), 404)["detail"]


def test_a_mask_comes_back_as_it_was_sent(http, sdk, scene):
    mask = picture(1)
    sdk.put_frame(scene, 0, pictures(5), masks=dict.fromkeys(pictures(), mask))
    assert http.get(f"/v1/scenes/{scene}/frames/0/cameras/{NAME}?kind=mask").content == mask


def test_a_tag_saves_the_body(http, address):
    for path in (f"{address}/cameras/{NAME}", f"{address}/splat.ply"):
        first = http.get(path)
        tag = first.headers["etag"]
        for known in (tag, f'"other", {tag}', f"W/{tag}", "*"):
            again = http.get(path, headers={"If-None-Match": known})
            assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", tag)
        assert http.get(path, headers={"If-None-Match": '"other"'}).content == first.content


@pytest.mark.parametrize(
    ("asked", "part"),
    [
        ("bytes=0-9", slice(0, 10)),
        ("bytes=5-", slice(5, None)),
        ("bytes=-7", slice(-7, None)),
        ("bytes=3-999999999", slice(3, None)),
        ("bytes=-999999999", slice(None)),
    ],
)
def test_a_range_of_bytes(http, address, asked, part):
    whole = http.get(f"{address}/cameras/{NAME}")
    answer = http.get(f"{address}/cameras/{NAME}", headers={"Range": asked})
    assert answer.status_code == 206
    assert answer.content == whole.content[part]
    start = range(len(whole.content))[part].start
    assert answer.headers["content-range"] == f"bytes {start}-{start + len(answer.content) - 1}/{len(whole.content)}"
    held = http.get(f"{address}/cameras/{NAME}", headers={"Range": asked, "If-Range": whole.headers["etag"]})
    assert held.content == answer.content
    other = http.get(f"{address}/cameras/{NAME}", headers={"Range": asked, "If-Range": '"other"'})
    assert (other.status_code, other.content) == (200, whole.content)


NO_RANGES = ("bytes=9-3", "bytes=-", "bytes=0-1,4-5", "lines=0-1", "bytes=a-b", "nonsense", "bytes=0-٣")


@pytest.mark.parametrize("asked", [*NO_RANGES, f"bytes=0-{'9' * 5000}", f"bytes={'9' * 5000}-"])
def test_a_range_that_is_none_gets_the_whole(http, address, asked):
    answer = http.get(f"{address}/cameras/{NAME}", headers={"Range": asked.encode()})
    assert (answer.status_code, answer.content) == (200, http.get(f"{address}/cameras/{NAME}").content)


@pytest.mark.parametrize("asked", ["bytes=999999999-", "bytes=-0"])
def test_a_range_behind_the_end_is_refused(http, address, asked):
    answer = http.get(f"{address}/cameras/{NAME}", headers={"Range": asked})
    assert problem(answer, 416)["field"] == "Range"
    whole = http.get(f"{address}/cameras/{NAME}").content
    assert answer.headers["content-range"] == f"bytes */{len(whole)}"


@pytest.mark.parametrize("path", ["/viewer/main.js", "/viewer/", "/docs/reference.html", "/docs/reference.js"])
def test_files_of_the_pages_are_not_sent_again(http, path):
    first = http.get(path)
    again = http.get(path, headers={"If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert again.headers["content-security-policy"] == first.headers["content-security-policy"]


def test_a_render_is_named(http, committed):
    answer = http.get(f"/v1/scenes/{committed}/render?camera={NAME}&frame=0&kind=depth&format=npz")
    assert answer.headers["content-disposition"] == f'inline; filename="{committed[:8]}-000000-{NAME}-depth.npz"'


def test_names_of_files_are_safe_in_a_header():
    assert content_disposition('a"b\\c/\r\n.png') == (
        "attachment; filename=\"a_b_c___.png\"; filename*=UTF-8''a%22b%5Cc%2F%0D%0A.png"
    )
    assert content_disposition("vorn–links.png").endswith("filename*=UTF-8''vorn%E2%80%93links.png")


def test_a_full_disk_ends_ingest_and_not_the_service(tmp_path, monkeypatch):
    running = Running(fake_settings(tmp_path))
    try:
        with httpx.Client(base_url=running.url, timeout=HANG_S) as http, Client(running.url) as sdk:
            assert sdk.ingest_ready().ingest_ready is True
            assert sdk.ready().ingest_ready is True
            usage = namedtuple("usage", "total used free")
            monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10**9, 10**9 - 5_000_000, 5_000_000))
            document = problem(http.get("/health/ingest"), 503)
            assert "5 MB free" in document["detail"]
            assert "retry-after" in http.get("/health/ingest").headers
            assert sdk.ready().ingest_ready is False
            assert sdk.scenes() == []
    finally:
        running.stop()
