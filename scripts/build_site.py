"""Builds the pages of docs/ as a site in server/site, which the service serves under /docs.

python scripts/build_site.py          # needs the extra `site`; scripts/setup runs it
python scripts/build_site.py FOLDER   # writes the site to another folder

README.md, CONTRIBUTING.md and CHANGELOG.md become pages as well. Links to source files become text, because the site
does not contain them.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
SITE = ROOT / "server" / "site"
OUTSIDE = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
"""Files of the root folder, and the names of their pages."""
EXAMPLES = "docs/examples/"
"""Folder of source files."""
LINK = re.compile(r"(?P<image>!?)\[(?P<text>[^\]]*)\]\((?P<target>[^)\s]+)\)")
FENCE = re.compile(r"(^```.*?^```)", re.DOTALL | re.MULTILINE)


def for_site(text: str, folder: str) -> str:
    """Returns a page with links as the site needs them.

    Args:
        text: Markdown of the page.
        folder: folder of the page, relative to the root of the project: ``""`` or ``"docs/"``.

    >>> for_site("[a](docs/api.md#x), [b](server/app.py) and [c](CHANGELOG.md)", "")
    '[a](api.md#x), b and [c](changelog.md)'
    >>> for_site("[a](api.md), [b](../README.md)", "docs/")
    '[a](api.md), [b](index.md)'
    """

    def replace(match: re.Match[str]) -> str:
        target, _, anchor = match["target"].partition("#")
        if not target or "://" in target:
            return match[0]
        name = target.removeprefix("../") if target.startswith("../") else folder + target
        if name in OUTSIDE:
            name = "docs/" + OUTSIDE[name]
        if not name.startswith("docs/") or name.startswith(EXAMPLES):
            return match["text"]
        link = name.removeprefix("docs/") + (f"#{anchor}" if anchor else "")
        return f"{match['image']}[{match['text']}]({link})"

    parts = FENCE.split(text)  # code is left as it is
    return "".join(part if k % 2 else LINK.sub(replace, part) for k, part in enumerate(parts))


def build(out: Path) -> None:
    """Builds the site in a folder, which replaces an earlier site.

    Raises:
        FileExistsError: if the folder exists and contains something else.
        subprocess.CalledProcessError: if a page has a link to a missing page or heading, or the build fails.
    """
    if out.exists() and not (out / "sitemap.xml").exists():
        raise FileExistsError(f"{out} is not a site: choose a new folder, or remove it")
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        shutil.copytree(ROOT / "docs", work / "docs", ignore=shutil.ignore_patterns("examples"))
        for page in (work / "docs").glob("*.md"):
            page.write_text(for_site(page.read_text(), "docs/"))
        for name, page_name in OUTSIDE.items():
            text = for_site((ROOT / name).read_text(), "").replace('src="docs/', 'src="')
            (work / "docs" / page_name).write_text(text)
        shutil.copy(ROOT / "mkdocs.yml", work)
        command = [sys.executable, "-m", "zensical", "build", "--strict", "--config-file", str(work / "mkdocs.yml")]
        subprocess.run(command, check=True, cwd=work, stdout=subprocess.DEVNULL)
        if out.exists():
            shutil.rmtree(out)
        shutil.move(work / "site", out)


if __name__ == "__main__":
    build(Path(sys.argv[1]) if sys.argv[1:] else SITE)
