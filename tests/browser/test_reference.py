"""The documentation and the API reference load nothing from other sites, under a policy, without errors."""

from __future__ import annotations

import httpx
import pytest
from browser_page import read_until
from waiting import HANG_S

from server.routes.reference import FILES


def test_it_is_drawn_from_this_service_alone(page, service):
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(f"{service.url}/docs/reference.html")
    page.get_by_text("Creates a scene from a rig").first.wait_for()
    page.get_by_text("Creates a scene from a rig").first.click()
    page.get_by_role("button", name="Try it out").first.wait_for()
    assert page.faults == []
    elsewhere = [url for url in asked if not url.startswith((service.url, "data:", "blob:"))]
    assert elsewhere == []


def test_its_files_have_a_policy_and_no_others_are_served(service):
    with httpx.Client(base_url=service.url, follow_redirects=True, timeout=HANG_S) as http:
        for path in ("/docs", "/docs/", "/redoc", "/docs/swagger-ui-bundle.js", "/docs/reference.js"):
            answer = http.get(path)
            assert answer.status_code == 200, path
            policy = answer.headers["Content-Security-Policy"]
            assert policy.startswith("default-src 'none'; script-src 'self'")
            assert "'unsafe-inline'" not in policy.split(";")[1]
        for name in ("favicon.png", "..%2Fapp.py", "redoc.standalone.js"):
            assert http.get(f"/docs/{name}").status_code == 404


@pytest.mark.skipif("index.html" not in FILES, reason="the site is not built: run scripts/setup dev")
def test_the_pages_are_shown_and_can_be_searched(page, service):
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(f"{service.url}/docs")
    page.get_by_role("heading", name="Try it").wait_for()
    field = page.get_by_role("combobox", name="Search")

    def press():  # the key has an effect only after the page's script has started
        page.keyboard.press("/")
        page.wait_for_timeout(1000)
        return field.is_visible()

    read_until(page, press, bool)
    field.fill("checkpoint")
    page.get_by_text("Order of writes").first.click()
    page.wait_for_url("**/docs/durability.html*")
    page.get_by_role("heading", name="Order of writes").wait_for()
    assert [url for url in asked if not url.startswith((service.url, "data:", "blob:"))] == []
    assert page.faults == []
