"""Names and other texts that people give, and that other people see in terminals, logs and the viewer."""

from __future__ import annotations

import unicodedata

import pytest
from running import make_rig, problem

from client.wire import RigModel

RIG = RigModel.of(make_rig()).model_dump(mode="json")
CONTROLS = ["\n", "\r", "\x00", "\x1b", "\x7f", "\x9b", "\u2028", "\u202e", "\u2066"]
PRINTABLE = [
    "Kamera Süd",
    unicodedata.normalize("NFD", "Süd"),
    "👨\u200d👩\u200d👧",
    "استوديو",
    "../x",
    "a\\b:c*?",
    "x" * 200,
]


@pytest.mark.parametrize("control", CONTROLS, ids=ascii)
def test_a_text_with_a_control_character_is_refused_by_name(http, quiet_scene, control):
    text = f"studio{control}[31m"
    for method, path, body, field in (
        ("POST", "/v1/scenes", {"rig": RIG, "name": text}, "name"),
        ("PATCH", f"/v1/scenes/{quiet_scene}", {"name": text}, "name"),
        ("POST", f"/v1/scenes/{quiet_scene}/frames/0/missing", {"reason": text}, "reason"),
    ):
        document = problem(http.request(method, path, json=body), 422)
        assert document["field"].rpartition(".")[2] == field
        assert f"control character {control!a} at position 6" in document["detail"]
        assert "printable" in document["remedy"]


@pytest.mark.parametrize("name", PRINTABLE, ids=ascii)
def test_a_printable_name_is_kept(http, quiet_scene, name):
    assert http.patch(f"/v1/scenes/{quiet_scene}", json={"name": name}).json()["name"] == name
    assert http.get(f"/v1/scenes/{quiet_scene}").json()["name"] == name
    assert http.patch(f"/v1/scenes/{quiet_scene}", json={"name": ""}).status_code == 200


@pytest.mark.parametrize(
    "name", ["a/b", "a\\b", "..", ".a", "a b", "é", "c0\n", "\x1b[31m", "time", "mask.c0", "x" * 65]
)
def test_a_camera_name_that_is_no_file_name_is_refused(http, name):
    cameras = [{**RIG["cameras"][0], "name": name}, RIG["cameras"][1]]
    answer = http.post("/v1/scenes", json={"rig": {**RIG, "cameras": cameras}})
    assert problem(answer, 422)["field"].startswith("body.rig")
