"""Warnings of a scene: what frame 0 leaves to be checked, listed once, and apart from the alarms of a frame."""

from __future__ import annotations

import browser_engine
import fakes
import pytest
from browser_page import FRAMES, expect, opened, push, shown, start_scene, until
from waiting import HANG_S

from client.sdk import Client


@pytest.fixture
def guessed(service):
    """A scene whose frame 0 is a guess, and whose calibration seems to be off; its last frame has alarms."""
    with Client(service.url, busy_timeout=HANG_S) as sdk:
        id = start_scene(sdk, "guessed")
        try:
            push(sdk, id, 0, red=fakes.GUESSED)
            for index in range(1, FRAMES):
                push(sdk, id, index)
            sdk.wait(id, FRAMES - 1)
            yield sdk, id
        finally:
            sdk.delete_scene(id)


def listed(page):
    """Sentences of the warnings, those that are folded away too."""
    return page.locator("#warnings li").all_text_contents()


def test_warnings_are_sentences_in_a_place_of_their_own(page, service, guessed):
    sdk, id = guessed
    opened(page, service, id)
    page.locator("#warnings").wait_for()
    said = listed(page)
    known = sdk.scene(id).warnings
    assert len(known) > len(browser_engine.OFF)
    assert [one.lower() for one in said] == [f"{one}.".lower() for one in known]
    assert said[0].startswith("Frame 0 is a guess: ")
    assert said[-1].endswith("frame 0.")
    expect(page.locator("#to-check")).to_have_text(f"{len(known)} to check", use_inner_text=True)
    # The alarms of the frame stay where they are, and only they have the colour of alarms.
    until(page, "document.getElementById('camera-summary').innerText.includes('c2')")
    colour = "(e) => getComputedStyle(e).color"
    assert page.locator("#camera-summary").evaluate(colour) != page.locator("#warnings li").first.evaluate(colour)
    assert "epipolar" not in page.locator("#camera-summary").inner_text()
    expect(page.locator("#state")).to_have_text("Ready", use_inner_text=True)
    page.locator("#time").fill("3")  # they are the scene's, whatever frame is looked at
    shown(page, frame="3")
    assert listed(page) == said
    assert page.faults == []


def test_many_are_folded_and_stay_as_they_were_left(page, service, guessed):
    sdk, id = guessed
    opened(page, service, id)
    rest = page.locator("#warnings details li")
    page.locator("#warnings summary").wait_for()
    expect(page.locator("#warnings summary")).to_have_text(f"{rest.count()} more", use_inner_text=True)
    expect(rest).to_have_count(len(sdk.scene(id).warnings) - 3)
    assert not rest.first.is_visible()
    page.focus("#warnings summary")
    page.keyboard.press("Space")  # opens them, and does not play
    assert rest.first.is_visible()
    expect(page.locator("#play")).to_have_attribute("aria-label", "Play")
    page.evaluate("document.querySelector('#warnings li').marked = true")
    push(sdk, id, FRAMES)
    shown(page, frame=str(FRAMES))
    assert rest.first.is_visible()
    assert page.evaluate("document.querySelector('#warnings li').marked")  # not made anew: nothing is read out again
    assert page.faults == []


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (390, 844)])
def test_the_button_leads_to_them_and_they_fit(page, service, guessed, width, height):
    _, id = guessed
    page.set_viewport_size({"width": width, "height": height})
    opened(page, service, id)
    page.locator("#to-check").wait_for()
    assert page.locator("#to-check").evaluate("(e) => e.parentElement.getAttribute('role')") == "status"
    page.click("#to-check")
    until(page, "document.activeElement.id === 'warnings-title'")
    page.wait_for_timeout(100)
    box = page.locator("#warnings").bounding_box()
    assert box["y"] >= 0
    assert box["y"] < 0.6 * height
    assert box["x"] >= 0
    assert box["x"] + box["width"] <= width
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    overflow = "(e) => e.scrollWidth > e.clientWidth"
    assert not any(one.evaluate(overflow) for one in page.locator("#warnings li:visible").all())
    assert page.faults == []


def test_a_scene_without_warnings_shows_none(page, service, finished, guessed):
    _, id = guessed
    opened(page, service, id)
    page.locator("#warnings").wait_for()
    page.select_option("#scenes", finished)
    shown(page, frame=str(FRAMES - 1))
    expect(page.locator("#warnings")).to_be_hidden()
    expect(page.locator("#to-check")).to_be_hidden()
    assert listed(page) == []
    assert page.faults == []
