"""The dialog of the cluster: nodes, what scenes take of them, what waits; not offered on a single machine."""

from __future__ import annotations

import copy

import pytest
from browser_page import FRAMES, expect, looked_at, opened, shown, until
from running import Running, fake_settings, make_rig

from client.sdk import Client

NODE = {
    "gpus": 0,
    "memory_mb": 16_000,
    "memory_reserved_mb": 0,
    "cpus": 8,
    "cpus_reserved": 0,
    "labels": {},
    "scenes": [],
}
WORDS = "document.getElementById('cluster-words').textContent"


def node(id, host, **more):
    return {**NODE, "id": id, "host": host, "alive": True, **more}


def told(scene):
    nodes = [
        node("n0", "head", cpus=0),
        node(
            "n1",
            "stage-1.studio.example",
            labels={"rig": "stage-a", "disk": "fast"},
            cpus_reserved=2.5,
            memory_reserved_mb=3_900,
            scenes=[scene, "0123456789ab"],
        ),
        node("n2", "stage-2.studio.example", alive=False),
        node("n3", "stage-3.studio.example"),
    ]
    needs = "1 CPU and 0.7 GB of memory on a node with rig=stage-b"
    waiting = [
        {"scene": "ba9876543210", "role": "worker", "needs": needs, "seconds": 200},
        {"scene": scene, "role": "exporter", "needs": "0.1 CPU and 0.2 GB of memory", "seconds": 1},
    ]
    return {"placement": "ray", "nodes": nodes, "waiting": waiting, "head_responds": True}


class Stub:
    """Answers `GET /v1/cluster` in place of the service; `answer` may be changed, None refuses."""

    def __init__(self, page, answer):
        self.answer, self.asked = answer, 0
        page.route("**/v1/cluster", self._fulfil)

    def _fulfil(self, route):
        self.asked += 1
        if self.answer is None:
            route.fulfill(status=503, json={"detail": "the service ends", "status": 503})
        else:
            route.fulfill(json=self.answer)


@pytest.fixture
def stubbed(sized, service, finished):
    """The page of a scene, with a cluster behind it."""
    stub = Stub(sized, told(finished))
    opened(sized, service, finished)
    shown(sized, frame=str(FRAMES - 1))
    return stub


def dialog(page):
    page.click("#cluster-open")
    until(page, f"{WORDS}.includes('alive')")


def test_on_one_machine_it_is_not_offered(sized, service, finished):
    asked = []
    sized.on("request", lambda request: asked.append(request.url) if request.url.endswith("/v1/cluster") else None)
    opened(sized, service, finished)
    shown(sized, frame=str(FRAMES - 1))
    sized.wait_for_timeout(5000)
    expect(sized.locator("#cluster-open")).to_be_hidden()
    assert len(asked) == 1
    assert sized.faults == []


def test_nodes_and_what_waits(sized, stubbed, finished):
    dialog(sized)
    expect(sized.locator("#cluster-words")).to_have_text(
        "3 nodes alive, 1 lost. 1 process is waiting for a node.", use_inner_text=True
    )
    cards = sized.locator("#cluster-nodes > li")
    lost, head, first, third = cards.all_inner_texts()  # the lost first, then by name
    assert lost.split() == ["stage-2.studio.example", "lost"]
    assert "No CPUs for scenes." in head
    for words in ("rig=stage-a · disk=fast", "2.5 of 8", "3.9 of 16.0 GB", f"ring ({finished[:6]})", "0123456789ab"):
        assert words in first
    assert "0 of 8" in third
    late, begins = sized.locator("#cluster-waits li").all_inner_texts()
    needs = "1 CPU and 0.7 GB of memory on a node with rig=stage-b"
    assert late.split("\n") == ["ba9876543210", f"The worker has been waiting for 3 min. It needs {needs}."]
    assert begins.split("\n") == [f"ring ({finished[:6]})", "The export is about to start."]
    looked_at(sized, "cluster")
    box = sized.locator("#cluster").bounding_box()
    assert box["x"] >= 0
    assert box["x"] + box["width"] <= sized.viewport_size["width"]
    assert sized.locator("#cluster .scroll").evaluate("(e) => e.scrollWidth <= e.clientWidth")


def test_it_follows_while_it_is_open_and_keeps_the_focus(sized, stubbed, finished):
    dialog(sized)
    sized.locator(f'#cluster-nodes [data-scene="{finished}"]').focus()
    changed = copy.deepcopy(stubbed.answer)
    changed["nodes"][1]["cpus_reserved"] = 7.25
    changed["waiting"] = []
    stubbed.answer = changed
    until(sized, "document.getElementById('cluster-nodes').innerText.includes('7.25 of 8')")
    assert sized.evaluate("document.activeElement.dataset.scene") == finished
    expect(sized.locator("#cluster-waiting")).to_be_hidden()
    assert sized.locator("#cluster-words").inner_text().endswith("No process is waiting for a node.")
    stubbed.answer = {**changed, "head_responds": False}
    until(sized, f"{WORDS}.startsWith('The head of the cluster does not respond')")
    stubbed.answer = None
    until(sized, f"{WORDS}.startsWith('The service ends. The list below')")
    expect(sized.locator("#cluster-nodes")).to_contain_text("7.25 of 8", use_inner_text=True)
    stubbed.answer = changed
    until(sized, f"{WORDS}.startsWith('3 nodes')")
    sized.keyboard.press("Escape")
    expect(sized.locator("#cluster[open]")).to_have_count(0)
    assert sized.evaluate("document.activeElement.id") == "cluster-open"
    asked = stubbed.asked
    sized.wait_for_timeout(4000)
    assert stubbed.asked == asked
    assert [fault for fault in sized.faults if "503" not in fault] == []


def test_a_scene_is_opened_from_its_node(sized, stubbed, finished):
    dialog(sized)
    sized.locator("#cluster-nodes button", has_text="0123456789ab").click()
    expect(sized.locator("#cluster[open]")).to_have_count(0)
    until(sized, "document.querySelector('#curtain h2').innerText === 'The scene cannot be opened'")


def test_its_button_moves_nothing_when_it_comes(sized, service, finished):
    held = []
    sized.route("**/v1/cluster", lambda route: held.append(route))
    opened(sized, service, finished)
    shown(sized, frame=str(FRAMES - 1))
    places = "['h1', '#scenes', '#state', '#manage-open', 'main'].map((s) => document.querySelector(s))"
    boxes = f"JSON.stringify({places}.map((e) => e.getBoundingClientRect()))"
    before = sized.evaluate(boxes)
    held[0].fulfill(json=told(finished))
    sized.locator("#cluster-open").wait_for()
    assert sized.evaluate(boxes) == before


def test_a_link_to_one_scene_does_not_ask(sized, tmp_path):
    token = "a-token-of-thirty-two-characters"
    running = Running(fake_settings(tmp_path, token=token))
    try:
        with Client(running.url, token=token) as sdk:
            links = sdk.share(sdk.create_scene(make_rig()).id).token, sdk.share().token
        asked = []
        sized.on("request", lambda request: asked.append(request.url) if request.url.endswith("/v1/cluster") else None)
        for link, count in zip(links, (0, 1), strict=True):
            sized.goto(f"{running.url}/#token={link}")
            until(sized, "document.querySelector('#curtain h2').innerText === 'Waiting for the first frame'")
            sized.wait_for_timeout(300)
            assert len(asked) == count
            sized.goto("about:blank")
        assert sized.faults == []
    finally:
        running.stop()
