"""A scene keeps its newest states exact; older ones go to compact files, and nobody who asks notices but by a hair."""

from __future__ import annotations

import numpy as np
from running import make_rig, pictures
from sending import create, finished, lasting_report, put_form, serving_with, status, view, wait_for

from client.wire import RigModel, StateBounds
from scas4d_core.compact import Bounds, CompactReader
from scas4d_core.storage.chunks import chunk_of

COUNT, EXACT = 32, 24


def sent(http, id, frames):
    for index in frames:
        put_form(http, id, index, pictures(index))
        assert finished(http, id, index)["state"] == "committed"


def folder_of(tmp_path, id):
    return tmp_path / "scenes" / id / "states"


def exact(folder):
    return sorted(int(path.stem[6:]) for path in folder.glob("frame_*.npz"))


def chunks(folder):
    return sorted(path for path in folder.iterdir() if chunk_of(path.name) is not None)


def read(data, tmp_path):
    path = tmp_path / "answer.s4d"
    path.write_bytes(data)
    return CompactReader(path)


def test_older_states_go_to_a_compact_file_and_are_asked_for_as_before(tmp_path):
    with serving_with(tmp_path) as (_, http, sdk):
        id = create(http, exact_states=EXACT, keep_frames={"last": 4})
        sent(http, id, range(3))
        before = {index: view(http, id, index).content for index in range(3)}
        sent(http, id, range(3, COUNT))
        folder = folder_of(tmp_path, id)
        wait_for(lambda: exact(folder) == [0, *range(COUNT - EXACT, COUNT)])
        assert len(chunks(folder)) == 1
        assert {index: view(http, id, index).content for index in range(3)} == before
        reports = [lasting_report(http, id, index) for index in range(COUNT)]
        assert [report["state"] for report in reports] == ["committed"] * COUNT
        assert http.get(f"/v1/scenes/{id}/tracks?ids=1").status_code == 200
        # Taken away: a file ends where the scene's own does, and has its bits.
        data, following = sdk.states(id, 3, parts=True)
        assert following == COUNT - EXACT
        with read(data, tmp_path) as answer, CompactReader(chunks(folder)[0]) as own:
            assert answer.frames == list(range(1, COUNT - EXACT))  # told from the file's first on
            for index in range(3, COUNT - EXACT):
                assert np.array_equal(answer.state(index).means, own.state(index).means)
            assert answer.parts() is not None
        data, following = sdk.states(id, COUNT - EXACT)
        assert following is None
        with read(data, tmp_path) as answer:
            assert answer.frames == list(range(COUNT - EXACT, COUNT))
        data, following = sdk.states(id)
        assert following == 1
    with serving_with(tmp_path) as (_, http, _sdk):  # after a start: all is there, and goes on
        assert status(http, id)["committed"] == COUNT
        assert {index: view(http, id, index).content for index in range(3)} == before
        report = lasting_report(http, id, 2)
        assert report == reports[2]
        sent(http, id, [COUNT])
        wait_for(lambda: exact(folder) == [0, *range(COUNT - EXACT + 1, COUNT + 1)])
        assert len(chunks(folder)) == 1
        assert not status(http, id)["damage"]


def test_a_damaged_compact_file_is_told_and_frames_are_made_again_or_lost(tmp_path):
    with serving_with(tmp_path) as (_, http, _sdk):
        id = create(http, exact_states=EXACT, keep_frames={"last": COUNT - 3})
        sent(http, id, range(COUNT))
        folder = folder_of(tmp_path, id)
        wait_for(lambda: exact(folder) == [0, *range(COUNT - EXACT, COUNT)])
        (chunk,) = chunks(folder)
        with CompactReader(chunk) as own:
            place = own._states[2]
        data = bytearray(chunk.read_bytes())
        data[place.offset + place.size // 2] ^= 8
        chunk.write_bytes(data)
        scene = status(http, id)
        assert not scene["damage"]
        response = view(http, id, 3)
        assert response.status_code in (404, 503)
        assert str(tmp_path) not in response.text
        wait_for(lambda: status(http, id)["damage"] and not status(http, id)["degraded"])
        for index in (1, 2, COUNT - EXACT, COUNT - 1):
            assert view(http, id, index).status_code == 200
        told = " ".join(status(http, id)["damage"])
        assert "frame 3" in told


def test_bounds_and_numbers_that_cannot_be_are_refused(tmp_path):
    with serving_with(tmp_path) as (_, http, _sdk):
        rig = RigModel.of(make_rig()).model_dump(mode="json")
        for ingest, field in (
            ({"exact_states": 3}, "exact_states"),
            ({"state_bounds": {"position": 0}}, "position"),
            ({"state_bounds": {"rotation": 0.0001}}, "rotation"),
        ):
            response = http.post("/v1/scenes", json={"rig": rig, "ingest": ingest})
            assert response.status_code == 422
            assert field in response.text


def test_the_bounds_of_a_scene_are_those_of_compact_files():
    assert StateBounds().model_dump() == Bounds().record()
