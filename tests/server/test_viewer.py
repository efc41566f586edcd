"""The viewer's files over HTTP; what they do in a browser is in tests/browser."""

from __future__ import annotations

import posixpath
import re

import pytest
from running import make_rig, pictures, problem

from server.routes.viewer import FILES, FOLDER

HTML = (FOLDER / "index.html").read_text()


def test_the_page_comes_with_a_strict_policy(http):
    response = http.get("/viewer/")
    assert response.headers["content-type"].startswith("text/html")
    policy = response.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "frame-ancestors 'none'" in policy
    assert "unsafe" not in policy
    assert "http" not in policy  # nothing from elsewhere
    assert response.text == HTML


@pytest.mark.parametrize("path", ["/", "/viewer"])
def test_people_find_it(http, path):
    assert http.get(path).headers["location"] == "viewer/"  # relative, for a proxy with a path prefix
    assert http.get(path, follow_redirects=True).text == HTML


def test_every_file_that_the_page_names_is_served(http):
    named = set(re.findall(r"(?:href|src)=\"(\w[\w./-]*)\"", HTML))
    for name, path in FILES.items():
        if path.suffix == ".js":
            imported = re.findall(r"(?:from |new URL\()\"(\.[\w./-]+)\"", path.read_text())
            named |= {posixpath.normpath(posixpath.join(posixpath.dirname(name), other)) for other in imported}
    assert {"main.js", "viewer.css", "icon.svg", "stream.js", "view/live.js"} <= named
    assert named | {"index.html"} == set(FILES)  # no file is left over
    kinds = {"js": "text/javascript", "css": "text/css", "svg": "image/svg+xml"}
    for name in named:
        assert http.get(f"/viewer/{name}").headers["content-type"].startswith(kinds[name.rpartition(".")[2]])
    assert not re.search(r"<script(?! type=\"module\" src=)|<style| on\w+=|style=", HTML)  # the policy would stop them


@pytest.mark.parametrize(
    "name", ["nothing.js", "..%2Fsettings.py", "%2e%2e/viewer.py", "view", "view/", "./main.js%20"]
)
def test_nothing_else_is_served(http, name):
    problem(http.get(f"/viewer/{name}"), 404)


def test_a_control_character_is_refused(http):
    for name in ("index.html%00", "main.js%0A"):
        assert problem(http.get(f"/viewer/{name}"), 400)["field"] == "path"


def test_the_rig_comes_back_as_it_was_given(http, scene):
    given = http.get(f"/v1/scenes/{scene}/rig").json()
    assert [camera["name"] for camera in given["cameras"]] == list(make_rig().names)
    assert given["cameras"][0]["world_to_camera"] == make_rig().cameras[0].world_to_camera.tolist()
    problem(http.get("/v1/scenes/nobody/rig"), 404)


def test_frames_are_listed_page_by_page(http, sdk, scene):
    assert http.get(f"/v1/scenes/{scene}/frames").json() == {"frames": [], "next": None}
    for index in range(3):
        sdk.put_frame(scene, index, pictures())
    sdk.wait(scene, 2)
    first = http.get(f"/v1/scenes/{scene}/frames?limit=2").json()
    assert ([frame["index"] for frame in first["frames"]], first["next"]) == ([0, 1], 2)
    rest = http.get(f"/v1/scenes/{scene}/frames?first={first['next']}").json()
    assert ([frame["index"] for frame in rest["frames"]], rest["next"]) == ([2], None)
    assert rest["frames"][0]["psnr"] == 31.5
    assert rest["frames"][0]["loss"] == []  # 100 numbers a frame; GET …/frames/{n} has them
    for query in ("limit=0", "limit=501", "first=-1"):
        problem(http.get(f"/v1/scenes/{scene}/frames?{query}"), 422)
