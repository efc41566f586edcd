"""The README's example in Python does what it says: run against the real service, with fewer iterations."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from client.sdk import Client
from scas4d_core.captures import open_capture
from server.settings import ServerSettings

pytestmark = pytest.mark.service

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
LINES = re.search(r"```python\n(.*?)```", README, re.DOTALL)[1]
SHORTER = '{"scene": {"image_scale": 0.5}, "static": {"iterations": 300}, "update": {"iterations": 20}}'


def replaced(text, old, new):
    assert text.count(old) == 1, old
    return text.replace(old, new)


@pytest.fixture(scope="module")
def after(tmp_path_factory):
    """The names of the example once it has run."""
    from running import Running

    running = Running(ServerSettings(data=tmp_path_factory.mktemp("readme")), core=None)
    lines = replaced(LINES, "Client()", f"Client({running.url!r})")
    lines = replaced(lines, '{"update": {"iterations": 100}}', SHORTER)
    lines = replaced(lines, '"samples/robot"', repr(str(ROOT / "samples/robot")))
    names = {}
    try:
        exec(compile(lines, "README.md", "exec"), names)
        with Client(running.url) as client:
            names["committed"] = client.scene(names["scene"].id).committed
    finally:
        running.stop()
    return names


def test_every_frame_is_committed_and_the_view_is_a_picture(after):
    assert after["committed"] == after["capture"].frame_count
    assert after["view"].shape == (256, 256, 3)
    assert after["view"].any()


def test_the_pixel_is_on_the_robot_and_moves(after):
    (id,), (path,) = after["tracks"].ids, after["tracks"].positions
    assert id >= 0
    assert len(path) == after["capture"].frame_count
    assert sum((a - b) ** 2 for a, b in zip(path[0], path[-1], strict=True)) ** 0.5 > 0.1  # metres, of an arm of 1.2
    ((u, v),) = eval(re.search(r"pixels=(\[\[.*?\]\])", LINES)[1])
    mask = open_capture(ROOT / "samples/robot").frame(0).masks["0"]
    assert mask[int(v), int(u)]


def test_parts_are_found(after):
    assert after["parts"].count == 6
