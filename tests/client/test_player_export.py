"""`scas4d export --player`: what the page holds, and what is refused."""

from __future__ import annotations

import base64
import re

import browser_engine
import numpy as np
import pytest
from export_cases import bent
from typer.testing import CliRunner

from client.cli.main import app
from client.exports.modules import script
from client.exports.player import export_player
from scas4d_core.compact import CompactReader
from scas4d_core.errors import InputError

NOWHERE = {"url": "http://127.0.0.1:9", "token": None}


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return bent.write(tmp_path_factory.mktemp("scene") / "states.s4d", browser_engine.make_rig())


def held(page, folder):
    """The compact file within a page."""
    pieces = re.findall(r'<script type="application/octet-stream">([^<]*)</script>', page.read_text())
    file = folder / "held.s4d"
    file.write_bytes(b"".join(map(base64.b64decode, pieces)))
    return file


def test_the_page_holds_the_file_as_it_is_and_is_named_after_its_folder(file, tmp_path):
    export_player(str(file), tmp_path / "out.html", **NOWHERE)
    assert held(tmp_path / "out.html", tmp_path).read_bytes() == file.read_bytes()
    text = (tmp_path / "out.html").read_text()
    assert f"<title>{file.parent.name}</title>" in text
    assert not re.search(r"\{\{|(?:src|href)=.(?!data:)|^import |^export ", text, re.MULTILINE)
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_some_frames_are_written_anew(file, tmp_path):
    export_player(str(file), tmp_path / "out.html", "14:18", **NOWHERE)
    with CompactReader(held(tmp_path / "out.html", tmp_path)) as some, CompactReader(file) as all_frames:
        assert some.frames == [14, 16, 18]
        assert (some.parts() == all_frames.parts()).all()
        mine, true = some.state(16), all_frames.state(16)
        assert np.abs(mine.means - true.means).max() < 0.02
        assert (mine.retired == true.retired).all()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["--player", "out.zip"], "ends in .html"),
        (["--player", "out.html", "--frames", "90:95"], "in the range 90:95"),
        (["--player", "out.html", "--format", "ply"], "--player cannot be combined"),
        ([], "specify --format, or --player"),
    ],
)
def test_what_cannot_be_is_refused_with_a_remedy(file, given, words):
    done = CliRunner().invoke(app, ["export", str(file), *given])
    assert done.exit_code != 0
    assert words in re.sub(r"[\s│]+", " ", done.output) + str(done.exception)


def test_modules_that_cannot_be_linked_are_refused(tmp_path):
    (tmp_path / "star.js").write_text('import * as all from "./other.js";\n')
    with pytest.raises(ValueError, match=r"star\.js: unsupported form of import or export: 'import "):
        script(tmp_path / "star.js", tmp_path)
    (tmp_path / "a.js").write_text('import { b } from "./b.js";\nexport const a = 1;\n')
    (tmp_path / "b.js").write_text('import { a } from "./a.js";\nexport const b = 1;\n')
    with pytest.raises(ValueError, match=r"a\.js → b\.js"):
        script(tmp_path / "a.js", tmp_path)


def test_too_much_for_a_browser_is_refused(file, tmp_path, monkeypatch):
    monkeypatch.setattr("client.exports.player.LARGEST", 1000)
    with pytest.raises(InputError, match="more than a browser can load"):
        export_player(str(file), tmp_path / "out.html", **NOWHERE)
    assert list(tmp_path.iterdir()) == []
