"""The tour that the demo starts: four steps, each marked when it is done; once closed, the tour does not return."""

from __future__ import annotations

from browser_page import expect


def drag(page):
    box = page.locator("#overlay").bounding_box()
    x, y = box["x"] + 0.7 * box["width"], box["y"] + 0.3 * box["height"]
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 30, y + 10, steps=3)
    page.mouse.up()


def test_steps_are_marked_as_done_and_a_closed_tour_does_not_return(page, service, finished):
    page.goto(f"{service.url}/#scene={finished}&tour")
    tour, done = page.locator("#tour"), page.locator("#tour.done")
    tour.wait_for()
    tries = [
        ("Look around", "#view.outlined", lambda: drag(page)),
        ("Move through time", "#time.outlined", lambda: page.locator("#time").press("ArrowLeft")),
        ("Follow a point", "#view.outlined", lambda: page.locator("#overlay").click()),
        ("Show the parts", "#modes.outlined", lambda: page.get_by_role("radio", name="Parts").click()),
    ]
    for number, (title, outlined, attempt) in enumerate(tries, start=1):
        expect(page.locator("#tour-title")).to_have_text(f"{number} of 4 {title}", use_inner_text=True)
        expect(page.locator(outlined)).to_have_count(1)
        expect(done).to_have_count(0)
        attempt()
        done.wait_for()
        page.locator("#tour-next").click()
    assert tour.is_hidden()
    expect(page.locator(".outlined")).to_have_count(0)
    assert "tour" not in page.url
    page.goto("about:blank")
    page.goto(f"{service.url}/#scene={finished}&tour")
    page.locator("#curtain").wait_for(state="hidden")
    assert tour.is_hidden()
    assert page.faults == []


def test_it_is_shown_only_if_the_address_asks_for_it(chromium, service, finished):
    context = chromium.new_context(viewport={"width": 400, "height": 700})
    page = context.new_page()
    page.goto(f"{service.url}/#scene={finished}")
    page.locator("#curtain").wait_for(state="hidden")
    expect(page.locator("#tour")).to_be_hidden()
    page.goto("about:blank")
    page.goto(f"{service.url}/#scene={finished}&tour")
    page.locator("#tour-next").click()
    page.locator("#tour-back").click()
    expect(page.locator("#tour-title")).to_contain_text("1 of 4", use_inner_text=True)
    page.locator("#tour-close").click()
    expect(page.locator("#tour")).to_be_hidden()
    context.close()
