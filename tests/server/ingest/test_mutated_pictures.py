"""Mutated images and masks at all doors: each is refused before its acknowledgement, or the worker decodes it.

SCAS4D_MUTATED_PICTURES sets their number; CI takes a few hundred:

    SCAS4D_MUTATED_PICTURES=5000 scripts/test -n 0 -s tests/server/ingest/test_mutated_pictures.py
"""

from __future__ import annotations

import json
import os
from collections import Counter

import pytest
from mutated_pictures import mutated, whole_files
from running import picture
from sending import finished, framed, put_camera, put_form, put_framed
from websockets.sync.client import connect

NUMBER = int(os.environ.get("SCAS4D_MUTATED_PICTURES", "300"))


def by_form(http, socket, id, index, files):
    answer = put_form(http, id, index, files)
    return answer.status_code, answer.json()


def by_frame(http, socket, id, index, files):
    answer = put_framed(http, id, index, images_of(files), masks=masks_of(files))
    return answer.status_code, answer.json()


def by_camera(http, socket, id, index, files):
    """The mutated file comes first, because an accepted one keeps the frame open; masks come before images."""
    for field in reversed(files):
        kind = {"kind": "mask"} if field.startswith("mask.") else {}
        answer = put_camera(http, id, index, field.removeprefix("mask."), files[field], **kind)
        if answer.status_code != 202:
            break
    return answer.status_code, answer.json()


def by_socket(http, socket, id, index, files):
    socket.send(framed(index, images_of(files), masks_of(files)))
    answer = json.loads(socket.recv())
    return answer["status"], answer.get("problem")


def images_of(files):
    return {field: data for field, data in files.items() if not field.startswith("mask.")}


def masks_of(files):
    return {field.removeprefix("mask."): data for field, data in files.items() if field.startswith("mask.")}


DOORS = (by_form, by_frame, by_camera, by_socket)


@pytest.mark.filterwarnings("default")  # of Pillow, about damaged metadata
def test_what_is_acknowledged_is_decoded_and_the_rest_is_refused_by_name(http, make, service):
    id = make(queue_frames=50)
    sent, refused = {}, Counter()
    with connect(f"{service.url.replace('http', 'ws')}/v1/scenes/{id}/ingest") as socket:
        for number in range(NUMBER):
            name, data = mutated(number)
            field = ("c1", "mask.c1")[number % 3 == 2]
            files = {"c0": picture(), "c1": picture()} | ({"mask.c0": picture(1)} if field == "mask.c1" else {})
            files = {name: file for name, file in files.items() if name != field} | {field: data}
            door = DOORS[number // len(whole_files()) % len(DOORS)]
            index = len(sent)
            status, document = door(http, socket, id, index, files)
            while status == 429:
                finished(http, id, index - 1)
                status, document = door(http, socket, id, index, files)
            if status == 202:
                sent[index] = f"{number}: {name}"
                continue
            assert status == 422, (number, name, document)
            assert document["field"] == field, (number, name, document)
            assert document["value"], (number, name, document)
            assert document["remedy"], (number, name, document)
            assert "BytesIO" not in document["detail"]
            refused[door.__name__] += 1
    lost = [
        (name, report["state"], report["dropped_cameras"], report["error"])
        for index, name in sent.items()
        if (report := finished(http, id, index))["state"] != "committed" or report["dropped_cameras"]
    ]
    print(
        f"{NUMBER} files: {len(sent)} acknowledged, {dict(refused)} refused, {len(lost)} acknowledged and not decoded"
    )
    assert lost == []
    assert len(sent) > NUMBER / 20
    assert min(refused[door.__name__] for door in DOORS) > NUMBER / 20
