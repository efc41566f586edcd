"""Requests to a service over plain HTTP, bodies that it refuses, and waiting for what follows."""

from __future__ import annotations

import contextlib
import struct
import zlib

import httpx
from running import Running, fake_settings, make_rig, picture, pictures
from waiting import HANG_S, wait_for

from client.sdk import Client
from client.wire import FRAME_MEDIA_TYPE, RigModel, frame_chunks

FRAMED = {"Content-Type": FRAME_MEDIA_TYPE}


@contextlib.contextmanager
def serving(folder):
    running = Running(fake_settings(folder))
    try:
        with (
            httpx.Client(base_url=running.url, timeout=HANG_S) as http,
            Client(running.url, busy_timeout=HANG_S) as sdk,
        ):
            yield http, sdk
    finally:
        running.stop()


def create(http, nodes=None, **ingest):
    body = {"rig": RigModel.of(make_rig()).model_dump(mode="json"), "ingest": ingest, "name": "studio"}
    return http.post("/v1/scenes", json={**body, "frames_per_second": 10, "nodes": nodes or {}}).json()["id"]


def put_form(http, id, index, images=None):
    files = {name: (name, data) for name, data in (images or pictures()).items()}
    return http.put(f"/v1/scenes/{id}/frames/{index}", files=files)


def framed(index, images=None, masks=None, time=None, **more):
    return b"".join(frame_chunks(index, pictures() if images is None else images, masks, time, **more))


def put_framed(http, id, index, images=None, **more):
    return http.put(f"/v1/scenes/{id}/frames/{index}", content=framed(index, images, **more), headers=FRAMED)


def put_camera(http, id, index, camera, data, **params):
    return http.put(f"/v1/scenes/{id}/frames/{index}/cameras/{camera}", content=data, params=params)


def status(http, id):
    return http.get(f"/v1/scenes/{id}").json()


def lasting_report(http, id, index):
    """The report of a frame without its latency, which a service only knows of the frames that it has seen itself."""
    return {**http.get(f"/v1/scenes/{id}/frames/{index}").json(), "latency": None}


def lasting_reports(http, id):
    return [{**report, "latency": None} for report in http.get(f"/v1/scenes/{id}/frames").json()["frames"]]


def finished(http, id, index):
    reports = []

    def over():
        reports.append(http.get(f"/v1/scenes/{id}/frames/{index}").json())
        return reports[-1].get("state") in ("committed", "failed", "missing", "skipped")

    wait_for(over)
    return reports[-1]


def settled(http, id):
    seen = []

    def rests():
        seen.append(status(http, id))
        return not seen[-1]["queued"] or seen[-1]["state"] == "paused"

    wait_for(rests)
    return seen[-1]


def declares(width, height):
    """A PNG whose header, checksum and all, declares another size."""
    header = b"IHDR" + struct.pack(">II", width, height) + picture()[24:29]
    return picture()[:12] + header + struct.pack(">I", zlib.crc32(header)) + picture()[33:]


@contextlib.contextmanager
def serving_with(folder, **changes):
    running = Running(fake_settings(folder, **changes))
    try:
        with (
            httpx.Client(base_url=running.url, timeout=HANG_S) as http,
            Client(running.url, busy_timeout=HANG_S) as sdk,
        ):
            yield running, http, sdk
    finally:
        running.stop()


def filled(http, count=2, red=0):
    id = create(http)
    for index in range(count):
        put_form(http, id, index, pictures(red))
        finished(http, id, index)
    settled(http, id)
    return id


def put_to_sleep(http, id):
    wait_for(lambda: http.post(f"/v1/scenes/{id}/sleep").status_code == 200)
    assert status(http, id)["asleep"] is True


def view(http, id, frame=None):
    query = {"camera": "c0"} | ({} if frame is None else {"frame": frame})
    return http.post(f"/v1/scenes/{id}/render", json=query)
