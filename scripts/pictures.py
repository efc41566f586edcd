"""Makes the pictures of the viewer and the player in docs/, from the current build and the sample.

PYTHONPATH=. python scripts/pictures.py           # needs `scripts/setup dev` and Chromium; takes some minutes
PYTHONPATH=. python scripts/pictures.py OUT       # writes to another folder
"""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

from client.cli import demo
from client.exports.player import export_player
from scas4d_core.captures import open_capture
from studies.machine import browser_path

ROOT = Path(__file__).parents[1]
SIZE, PLAYER_SIZE, PANEL_SIZE = (1280, 800), (1280, 720), (960, 600)
FRAME = 7
POINTS = ((0.475, 0.12), (0.46, 0.22), (0.48, 0.34), (0.50, 0.50))
"""Points of the robot to track, as fractions of the view's width and height."""
TIMEOUT_MS = 240_000
QUALITY = 82


def save(page: Page, file: Path) -> None:
    """Saves a screenshot as WebP."""
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.open(io.BytesIO(page.screenshot())).convert("RGB").save(file, quality=QUALITY, method=6)


def wait_for_picture(page: Page) -> None:
    """Waits until the service's exact picture is shown, with all panels."""
    page.wait_for_selector("#curtain", state="hidden")
    page.wait_for_selector("#view[data-drawn=service]:not(.stale)")
    page.wait_for_timeout(1500)


def picture_viewer(page: Page, address: str, out: Path) -> None:
    """Makes the pictures of the viewer: tracks, parts, exports, and the panel of accuracy and time."""
    page.set_viewport_size({"width": SIZE[0], "height": SIZE[1]})
    page.goto(address)
    wait_for_picture(page)
    box = page.locator("#overlay").bounding_box()
    assert box is not None
    for x, y in POINTS:
        page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
        page.wait_for_timeout(300)
    page.locator("#tracks li").nth(len(POINTS) - 1).wait_for()
    wait_for_picture(page)
    save(page, out / "viewer-tracks.webp")
    page.locator("#clear").click()
    page.get_by_role("radio", name="Parts").click()
    page.wait_for_selector("#view[data-mode=parts]")
    page.locator("aside").evaluate("panels => panels.scrollTo(0, 0)")
    wait_for_picture(page)
    save(page, out / "viewer-parts.webp")
    page.get_by_role("radio", name="Colour").click()
    page.locator("#measure").click()
    page.locator("#measure", has_text="Stop").wait_for()
    page.locator("#measure", has_text="Measure").wait_for()
    page.select_option("#budget-kind", "iterations")
    page.locator("#tradeoff").evaluate("chart => chart.closest('section').scrollIntoView()")
    wait_for_picture(page)
    save(page, out / "viewer-budget.webp")
    page.set_viewport_size({"width": PANEL_SIZE[0], "height": PANEL_SIZE[1]})
    page.select_option("#take-format", "usd")
    page.locator("#take-make").click()
    page.wait_for_selector("#take-list li a, #take-list li button:has-text('Save')")
    page.locator("#take").evaluate("panel => panel.scrollIntoView()")
    wait_for_picture(page)
    save(page, out / "exports" / "take-away.webp")


def picture_player(page: Page, file: Path, out: Path) -> None:
    """Makes the picture of the player in the last frame, with trails."""
    page.set_viewport_size({"width": PLAYER_SIZE[0], "height": PLAYER_SIZE[1]})
    page.goto(file.as_uri())
    page.wait_for_selector("#curtain", state="hidden")
    box = page.locator("#overlay").bounding_box()
    assert box is not None
    page.mouse.click(box["x"] + 0.51 * box["width"], box["y"] + 0.5 * box["height"])
    page.select_option("#trails", "1000")
    page.locator("#time").press("End")
    page.wait_for_timeout(3000)
    save(page, out / "player.webp")


def main(out: Path) -> None:
    """Reconstructs the sample in a service, and makes all pictures."""
    capture = open_capture(ROOT / "samples" / "robot")
    with (
        tempfile.TemporaryDirectory() as temporary,
        demo.running_service(Path(temporary, "data"), Path(temporary, "log")) as url,
        sync_playwright() as playwright,
    ):
        scene = demo.run(capture, url, Path(temporary, "images"), frames=None, preset="scas4d", settings={})
        player = Path(temporary, "player.html")
        export_player(scene, player, url=url, token=None)
        browser = playwright.chromium.launch(executable_path=browser_path(), args=["--no-sandbox"])
        page = browser.new_page()
        page.set_default_timeout(TIMEOUT_MS)
        picture_viewer(page, f"{url}/#scene={scene}&frame={FRAME}", out)
        picture_player(page, player, out)
        browser.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]) if sys.argv[1:] else ROOT / "docs")
