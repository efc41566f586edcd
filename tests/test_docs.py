"""Links, anchors, files and studies that the README and docs/ name."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from typer.main import get_command

from scas4d_core.engines.choose import WARP_DEVICE
from server.settings import CONFIG, PREFIX, URL, ServerSettings
from studies.commands import app

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
FENCE = re.compile(r"^```.*?^```", re.M | re.S)
FOLDERS = ("client", "docker", "docs", "samples", "scas4d_core", "scripts", "server", "studies", "tests")
FILE = re.compile(rf"`((?:{'|'.join(FOLDERS)})/[\w./-]*)`")


def anchors(page: Path) -> set[str]:
    """Anchors of a page: of its headings, as GitHub makes them, and explicit ones."""
    text = FENCE.sub("", page.read_text())
    headings = re.findall(r"^#+ (.+)$", text, re.M)
    named = re.findall(r'<a id="([^"]+)">', text)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings} | {*named}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_resolve(page: Path) -> None:
    for link in LINK.findall(FENCE.sub("", page.read_text())):
        if "://" in link:
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), f"{page.name} links to {link}: there is no such file"
        assert not anchor or anchor in anchors(target), f"{page.name} links to {link}: there is no such heading"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_named_files_exist(page: Path) -> None:
    missing = [name for name in FILE.findall(page.read_text()) if not (ROOT / name).exists()]
    assert not missing, f"{page.name} names files that do not exist: {', '.join(missing)}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_named_studies_exist(page: Path) -> None:
    known = get_command(app).list_commands(None)
    unknown = set(re.findall(r"scripts/bench ([a-z]+(?:-[a-z]+)*)", page.read_text())) - {*known}
    assert not unknown, f"{page.name} names studies that do not exist: {', '.join(unknown)}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_named_variables_are_settings(page: Path) -> None:
    known = {f"{PREFIX}{name.upper()}" for name in ServerSettings.model_fields} | {CONFIG, URL, WARP_DEVICE}
    unknown = set(re.findall(r"SCAS4D_[A-Z][A-Z_]*[A-Z]", page.read_text())) - known
    assert not unknown, f"{page.name} names variables that are no settings: {', '.join(unknown)}"


def test_the_table_of_folders_is_current() -> None:
    command = [sys.executable, "scripts/folder_table.py", "--check"]
    assert subprocess.run(command, cwd=ROOT, check=False).returncode == 0, "run scripts/folder_table.py"


def test_the_site_is_built_with_every_page_and_without_broken_links(tmp_path: Path) -> None:
    command = [sys.executable, "scripts/build_site.py", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    built = {path.stem for path in (tmp_path / "site").glob("*.html")}
    assert {page.stem for page in PAGES} - {"README"} < built
    navigation = (ROOT / "mkdocs.yml").read_text()
    assert not [page.name for page in PAGES[1:] if f": {page.name}\n" not in navigation]


@pytest.mark.parametrize("script", ["figures.py", "build_site.py"])
def test_examples_in_scripts_run(script: str) -> None:
    command = [sys.executable, "-m", "doctest", f"scripts/{script}"]
    done = subprocess.run(command, cwd=ROOT, env={"PYTHONPATH": str(ROOT)}, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
