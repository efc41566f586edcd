"""The API's reference draws itself with nothing from another site, under a policy, with no error."""

from __future__ import annotations

import httpx
from waiting import HANG_S


def test_it_is_drawn_from_this_service_alone(page, service):
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(f"{service.url}/docs")
    page.get_by_text("Creates a scene from a rig").first.wait_for()
    page.get_by_text("Creates a scene from a rig").first.click()
    page.get_by_role("button", name="Try it out").first.wait_for()
    assert page.faults == []
    elsewhere = [url for url in asked if not url.startswith((service.url, "data:", "blob:"))]
    assert elsewhere == []


def test_its_files_have_a_policy_and_no_others_are_served(service):
    with httpx.Client(base_url=service.url, follow_redirects=True, timeout=HANG_S) as http:
        for path in ("/docs", "/redoc", "/docs/swagger-ui-bundle.js", "/docs/reference.js"):
            answer = http.get(path)
            assert answer.status_code == 200, path
            assert "default-src 'none'; script-src 'self';" in answer.headers["Content-Security-Policy"]
        for name in ("favicon.png", "..%2Fapp.py", "redoc.standalone.js"):
            assert http.get(f"/docs/{name}").status_code == 404
