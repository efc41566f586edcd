"""The panel of files for other tools: made, followed, saved and removed by keyboard; errors in words; for readers."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

import pytest
from browser_page import expect, opened, push, start_scene, until
from waiting import HANG_S

from client.sdk import Client
from server.processes import exporter
from server.scene import exports as rules


def text(page, id):
    return page.locator(f"#{id}").inner_text()


def pictured(page, name):
    if folder := os.environ.get("SCAS4D_TEST_PICTURES"):
        page.locator("#take").scroll_into_view_if_needed()
        page.screenshot(path=str(Path(folder) / f"{name}.png"))


def ready(page):
    until(page, "!document.getElementById('take-make').disabled")


@pytest.fixture(scope="module")
def scene(service):
    with Client(service.url, busy_timeout=HANG_S) as sdk:
        id = start_scene(sdk, "takeaway")
        for index in range(4):
            push(sdk, id, index)
        sdk.wait(id, 3)
        yield sdk, id
        sdk.delete_scene(id)


def test_a_file_is_made_and_saved_by_keyboard(page, service, scene, tmp_path):
    sdk, id = scene
    opened(page, service, id)
    ready(page)
    page.focus("#take-format")
    page.select_option("#take-format", "ply")
    page.fill("#take-first", "1")
    page.fill("#take-last", "2")
    page.keyboard.press("Enter")
    until(page, "document.querySelector('#take-list .save')")
    assert "done" in text(page, "take-words")
    row = page.locator("#take-list li")
    assert row.inner_text().startswith("3DGS .ply, frames 1 to 2")
    assert "2 frames" in row.inner_text()
    pictured(page, "take-away-desk")
    link = page.get_by_label("Save 3DGS .ply, frames 1 to 2")
    with page.expect_download() as download:
        link.click()
    assert download.value.suggested_filename == "takeaway-000001-000002-ply.zip"
    download.value.save_as(tmp_path / "a.zip")
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        assert len(archive.namelist()) == 2
    page.get_by_label("Remove 3DGS .ply, frames 1 to 2").focus()
    page.keyboard.press("Enter")
    until(page, "!document.querySelector('#take-list li')")
    assert sdk.exports(id).exports == []
    assert page.evaluate("document.activeElement.id") == "take-format"
    assert page.faults == []


def test_faults_are_told_in_words_and_the_phone_shows_it_all(chromium, service, scene, monkeypatch):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="pip install axe-playwright-python")
    sdk, id = scene
    context = chromium.new_context(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    page = context.new_page()
    page.set_default_timeout(1000 * HANG_S)
    opened(page, service, id)
    ready(page)
    page.select_option("#take-format", "poses")
    page.click("#take-make")
    until(page, "document.querySelector('#take-list .save')")
    page.fill("#take-first", "3")
    page.fill("#take-last", "2")
    page.click("#take-make")
    until(page, "document.getElementById('take-words').innerText.includes('No committed frames from 3 to 2')")
    monkeypatch.setattr(rules, "free_bytes", lambda path: exporter.RESERVE_BYTES - 1)
    page.fill("#take-first", "")
    page.fill("#take-last", "")
    page.click("#take-make")
    until(page, "document.getElementById('take-words').innerText.includes('The disk has')")
    pictured(page, "take-away-phone")
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    box = page.locator("#take-list .save").bounding_box()
    assert min(box["width"], box["height"]) >= 44
    found = axe.Axe().run(page).response["violations"]
    assert [one["id"] for one in found if one["impact"] in ("serious", "critical")] == []
    context.close()
    for one in sdk.exports(id).exports:
        sdk.delete_export(id, one.id)


def test_who_may_only_read_saves_what_is_there_and_makes_none(page, service, scene):
    sdk, id = scene
    page.goto(f"{service.url}/#scene={id}&token=scas4d.read.whoever")  # a service without a token takes any
    until(page, "document.getElementById('facts').children.length > 0")
    assert page.is_hidden("#take")
    begun = sdk.begin_export(id, "tracks")
    page.reload()
    until(page, "document.querySelector('#take-list .save')")
    assert page.is_hidden("#take-form")
    expect(page.locator("#take-list button")).to_have_count(1)  # to save; none removes
    page.evaluate("() => { delete window.showSaveFilePicker; }")
    with page.expect_download() as download:
        page.click("#take-list .save")
    assert download.value.suggested_filename.endswith("-tracks.csv")
    assert page.faults == []
    sdk.delete_export(id, begun.id)


@pytest.mark.parametrize(("status", "most"), [(404, 1), (500, 2)])
def test_errors_of_the_list_are_not_asked_about_for_ever(page, service, scene, status, most):
    asked = []

    def answer(route):
        asked.append(route.request.url)
        route.fulfill(status=status, json={"detail": "no such scene", "status": status})

    page.route("**/exports", answer)
    opened(page, service, scene[1])
    until(page, "document.getElementById('facts').children.length > 0")
    page.wait_for_timeout(2200)  # three times as long as between two looks at an export under way
    assert 1 <= len(asked) <= most, asked
