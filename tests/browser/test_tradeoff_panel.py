"""The panel of accuracy and time, and frames that were held: what a person sees and changes."""

from __future__ import annotations

import fakes
import pytest
from browser_page import expect, opened, push, shown, start_scene, until
from waiting import HANG_S

from client.sdk import Client
from client.wire import Budget

GROUPED = """async () => {
  const { Tradeoff } = await import("/viewer/panels/tradeoff.js");
  const panel = new Tradeoff((id) => document.getElementById(id));
  const point = { kind: "measured", error: 0.02, psnr: 30, threads: 1 };
  const points = [[90, 1000, 3], [110, 1010, 4], [200, 2000, 2]].map(([iterations, milliseconds, frames]) =>
    ({ ...point, iterations, milliseconds, frames }));
  const effective = { iterations: 100, budget_ms: 1000 };
  panel.show({ points, model: null, replay: { state: "none" } }, { requested: effective, effective, since: 1 });
}"""
"""Draws points that a fake cannot have run: of two that took as long, and one that took longer."""


@pytest.fixture
def ran(service):
    """Frames with 100 and 40 iterations; frame 6 is held, of frame 7 a camera is left out."""
    with Client(service.url, busy_timeout=HANG_S) as sdk:
        id = start_scene(sdk, "budgets")
        for index in range(9):
            if index == 4:
                sdk.set_budget(id, iterations=40)
            push(sdk, id, index, red={6: fakes.HELD, 7: fakes.LEAVES_OUT}.get(index, 0))
            sdk.wait(id, index)
        yield sdk, id
        sdk.delete_scene(id)


def text(page, id):
    return page.locator(f"#{id}").inner_text()


def test_what_was_measured_and_what_is_extrapolated_are_told_apart(page, service, ran):
    _, id = ran
    opened(page, service, id)
    until(page, "document.querySelectorAll('#tradeoff .point.measured').length === 2")
    expect(page.locator("#tradeoff .point.extrapolated")).to_have_count(6)
    expect(page.locator("#tradeoff .point.replayed")).to_have_count(0)
    said = page.locator("#tradeoff .point.measured title").first.text_content()
    assert said.startswith("40 iterations")
    assert "error 0.0250" in said
    assert "measured" in said
    assert "time only" in page.locator("#tradeoff .point.extrapolated title").first.text_content()
    assert text(page, "tradeoff-unit").startswith("error")
    assert "40 iterations per frame, from frame 4 on" in text(page, "budget-words")
    expect(page.locator("#seconds .change")).to_have_count(1)  # where the budget changed
    assert page.faults == []


def test_a_budget_that_is_moved_holds_from_the_next_frame_on(page, service, ran):
    sdk, id = ran
    opened(page, service, id)
    until(page, "document.getElementById('budget-value').innerText === '40 iterations'")
    page.focus("#budget")
    page.keyboard.press("End")
    until(page, "document.getElementById('budget-words').innerText.includes('1000 iterations per frame, from frame 9')")
    assert sdk.budget(id).requested == Budget(iterations=1000)
    assert text(page, "budget-effect").startswith("No frames since")
    push(sdk, id, 9)
    until(page, "document.querySelectorAll('#seconds .change').length === 2")
    until(page, "document.getElementById('budget-effect').innerText.startsWith('Since then, one frame: 8 s')")
    page.select_option("#budget-kind", "budget_ms")
    page.focus("#budget")
    page.keyboard.press("Home")
    until(page, "document.getElementById('budget-words').innerText.includes('as fit into 20 ms')")
    assert sdk.budget(id).requested == Budget(budget_ms=20)
    page.select_option("#budget-kind", "")
    until(page, "document.getElementById('budget-words').innerText.includes('as the scene was created')")
    assert sdk.budget(id).requested == Budget()
    assert page.faults == []


def test_a_slider_that_is_let_go_where_it_was_changes_nothing(page, service, ran):
    sdk, id = ran
    opened(page, service, id)
    until(page, "document.getElementById('budget-value').innerText === '40 iterations'")
    before = sdk.budget(id)
    page.locator("#budget").scroll_into_view_if_needed()
    box = page.locator("#budget").bounding_box()
    share = float(page.locator("#budget").input_value()) / 1000
    x, y = box["x"] + 8 + share * (box["width"] - 16), box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 60, y, steps=3)
    until(page, "document.querySelector('#tradeoff .budget').textContent === 'new budget'")
    assert "Then: about" in text(page, "budget-words")
    page.mouse.move(x, y, steps=3)
    page.mouse.up()
    until(page, "document.querySelector('#tradeoff .budget').textContent === 'budget'")
    until(page, "document.getElementById('budget-value').innerText === '40 iterations'")
    assert sdk.budget(id) == before
    assert page.faults == []


def test_frames_under_a_budget_in_time_are_one_point(page, service):
    with Client(service.url, busy_timeout=HANG_S) as sdk:
        id = start_scene(sdk, "times")
        for index in range(4):
            push(sdk, id, index)
            sdk.wait(id, index)
        opened(page, service, id)
        until(page, "document.querySelectorAll('#tradeoff .point.measured').length === 1")
        page.evaluate(GROUPED)
        expect(page.locator("#tradeoff .point.measured")).to_have_count(2)
        titles = page.locator("#tradeoff .point.measured title").all_text_contents()
        assert titles[0].startswith("90 to 110 iterations")
        assert "7 frames" in titles[0]
        sdk.delete_scene(id)
        assert page.faults == []


def test_other_budgets_are_measured_on_request_until_told_to_stop(page, service, ran):
    sdk, id = ran
    opened(page, service, id)
    until(page, "!document.getElementById('measure').disabled")
    page.click("#measure")
    until(page, "document.querySelectorAll('#tradeoff .point.replayed').length === 4")  # 25, 50, 200 and its own 40
    assert "comparable only with each other" in text(page, "replay-words")
    assert text(page, "measure").startswith("Measure 25")
    push(sdk, id, 9, red=fakes.SLOW)  # two seconds in a replay, too
    sdk.wait(id, 9)
    page.click("#measure")
    until(page, "document.getElementById('measure').innerText === 'Stop'")
    page.click("#measure")
    until(page, "document.getElementById('replay-words').innerText.includes('stopped on request')")
    assert sdk.tradeoff(id).replay.state == "failed"
    assert page.faults == []


def test_held_frames_are_marked_with_their_reason_and_cameras_have_their_health(page, service, ran):
    _, id = ran
    opened(page, service, id, frame=6)
    shown(page, frame="6")
    expect(page.locator("#marks span")).to_have_count(1)
    assert "the fake was asked to" in page.locator("#marks span").get_attribute("title")
    assert text(page, "moment").endswith("rejected")
    assert text(page, "reason") == "Frame 6: previous state kept: the fake was asked to."
    expect(page.locator("#psnr .rejected")).to_have_count(1)
    page.locator("#time").fill("7")
    shown(page, frame="7")
    expect(page.locator("#reason")).to_be_hidden()
    rows = page.locator("#cameras tr").all_inner_texts()
    assert "left out" in rows[1]
    assert "20%" in rows[2]
    assert "95%" in rows[0]
    assert "camera c1" in text(page, "camera-summary").lower()
    page.locator("#marks span").click()
    shown(page, frame="6")
    assert page.faults == []
