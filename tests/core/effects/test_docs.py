"""The page of effects: its table is today's, and its worked example works, is off when off, and leaves no trace."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from effect_cases import UPDATE, same, updated
from source_tree import ROOT

from scas4d_core.effect_names import EFFECTS
from scas4d_core.effects import effect as effect_module
from scas4d_core.effects.switches import first_switches, names_on
from scas4d_core.settings import Settings

PAGE = (ROOT / "docs" / "effects.md").read_text()


def test_the_table_is_todays() -> None:
    command = [sys.executable, "scripts/effects_table.py", "--check"]
    assert subprocess.run(command, cwd=ROOT, env={"PYTHONPATH": str(ROOT)}, check=False).returncode == 0
    assert all(f"| `{name}` |" in PAGE for name in EFFECTS)


@pytest.fixture
def drag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The example of the page, its file and its line in place."""
    line = re.search(r'^    "(\w+)": "([\w.]+)",$', PAGE, re.MULTILINE)
    assert line is not None
    name, place = line.groups()
    source = PAGE.split("```python\n")[1].split("```")[0]
    module = place.rsplit(".", 1)[1]
    (tmp_path / f"{module}.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(EFFECTS, name, module)
    effect_module.effect.cache_clear()
    yield name
    sys.modules.pop(module, None)
    effect_module.effect.cache_clear()


def test_the_example_works_and_is_nothing_when_off(drag: str) -> None:
    usual = names_on(first_switches(Settings(update=UPDATE), 0))
    assert usual[-1] == drag
    without = [name for name in usual if name != drag]
    off = updated(without)
    on = updated(list(usual))
    assert not same(on, off)
    del EFFECTS[drag]  # its line is taken away
    assert names_on(first_switches(Settings(update=UPDATE), 0)) == tuple(without)
    assert same(updated(list(names_on(first_switches(Settings(update=UPDATE), 0)))), off)


def test_the_example_can_be_pinned_off(drag: str) -> None:
    assert not first_switches(Settings(effects={drag: "off"}), 0)[drag].on
    with pytest.raises(ValueError, match=f"unknown effect '{drag}s'"):
        Settings(effects={f"{drag}s": "off"})
