"""A scene that begins again while the page looks at it: nothing of the reconstruction before is shown any more."""

from __future__ import annotations

import pytest
from browser_page import expect, opened, push, shown, start_scene, until
from waiting import HANG_S

from client.sdk import Client


@pytest.fixture
def five(service):
    """A scene with five committed frames."""
    with Client(service.url, busy_timeout=HANG_S) as sdk:
        id = start_scene(sdk, "again")
        try:
            for index in range(5):
                push(sdk, id, index)
            sdk.wait(id, 4)
            yield sdk, id
        finally:
            sdk.delete_scene(id)


class Held:
    """The first answer at an address, as it was then, given to the page when told to."""

    def __init__(self, page, pattern):
        self.route = None
        self.answer = None
        page.route(pattern, self._hold)

    def _hold(self, route):
        if self.route is not None:
            route.continue_()
        else:
            self.route, self.answer = route, route.fetch()

    def give(self):
        self.route.fulfill(response=self.answer)


def test_reports_and_costs_that_come_late_are_those_of_another_reconstruction(page, service, five):
    sdk, id = five
    reports, costs = Held(page, "**/frames?first=0"), Held(page, "**/tradeoff")
    opened(page, service, id)
    shown(page, frame="4")
    for held in (reports, costs):
        while held.answer is None:
            page.wait_for_timeout(50)
    sdk.begin_again(id, 1, frame=4, discard=True)
    sdk.wait(id, 4)
    until(page, "document.querySelectorAll('#psnr .dot').length === 1")
    expect(page.locator("#tradeoff .point")).to_have_count(0)  # there is no update yet
    reports.give()
    costs.give()
    page.wait_for_timeout(500)
    expect(page.locator("#psnr .dot")).to_have_count(1)
    expect(page.locator("#tradeoff .point")).to_have_count(0)
    push(sdk, id, 5)
    until(page, "document.querySelectorAll('#psnr .dot').length === 2")
    until(page, "document.querySelectorAll('#tradeoff .point.measured').length === 1")
    assert [fault for fault in page.faults if "503" not in fault] == []  # while it begins
