"""The tour that the demo starts: four steps, each marked when it is done; once closed, the tour does not return."""

from __future__ import annotations


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
        assert page.locator("#tour-title").inner_text() == f"{number} of 4 {title}"
        assert page.locator(outlined).count() == 1
        assert done.count() == 0
        attempt()
        done.wait_for()
        page.locator("#tour-next").click()
    assert tour.is_hidden()
    assert page.locator(".outlined").count() == 0
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
    assert page.locator("#tour").is_hidden()
    page.goto("about:blank")
    page.goto(f"{service.url}/#scene={finished}&tour")
    page.locator("#tour-next").click()
    page.locator("#tour-back").click()
    assert "1 of 4" in page.locator("#tour-title").inner_text()
    page.locator("#tour-close").click()
    assert page.locator("#tour").is_hidden()
    context.close()
