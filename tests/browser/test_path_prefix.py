"""The pages behind a proxy that serves them under a path prefix and removes it."""

from __future__ import annotations

import pytest
from browser_page import FRAMES, shown
from waiting import HANG_S

from client.sdk import Client
from client.stream import Stream, scene_changes

PREFIX = "/studio/4d"


@pytest.fixture
def prefixed(service):
    """The service's URL, as long as it answers only under the prefix."""
    config, app = service.server.config, service.server.config.loaded_app

    async def without_prefix(scope, receive, send):
        if "path" not in scope:
            await app(scope, receive, send)
            return
        path = scope["path"].removeprefix(PREFIX) if scope["path"].startswith(f"{PREFIX}/") else "/outside/the/prefix"
        await app({**scope, "path": path, "raw_path": path.encode()}, receive, send)

    config.loaded_app = without_prefix
    yield service.url + PREFIX
    config.loaded_app = app


def test_the_viewer_shows_a_live_scene_under_a_prefix(page, prefixed, finished):
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    page.on("websocket", lambda socket: asked.append(socket.url.replace("ws", "http", 1)))
    page.goto(f"{prefixed}/#scene={finished}")
    picture = shown(page, frame=str(FRAMES - 1), mode="colour")
    assert picture[..., :3].max() > 100
    assert any(url.endswith("/stream") for url in asked)
    assert [url for url in asked if not url.startswith((f"{prefixed}/", "data:", "blob:"))] == []
    assert page.faults == []


def test_the_sdk_works_under_a_prefix(prefixed, finished):
    with Client(f"{prefixed}/", busy_timeout=HANG_S) as sdk:
        assert sdk.scene(finished).committed == FRAMES
        with Stream(f"{prefixed}/", finished) as stream:
            stream.subscribe("scene", scene_changes())
            assert next(iter(stream)).status.committed == FRAMES


def test_the_reference_sends_its_requests_under_a_prefix(page, prefixed, finished):
    page.goto(f"{prefixed}/docs/reference.html")
    page.get_by_text("Lists all scenes").first.click()
    page.get_by_role("button", name="Try it out").first.click()
    with page.expect_response(f"{prefixed}/v1/scenes*") as answer:
        page.get_by_role("button", name="Execute").first.click()
    assert answer.value.status == 200
    assert page.faults == []
