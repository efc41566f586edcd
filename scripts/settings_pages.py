"""Writes the tables of settings and guards in docs/ from their definitions.

python scripts/settings_pages.py            # writes
python scripts/settings_pages.py --check    # exits with an error if a page is out of date
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from client.cli.changes import format_changes
from scas4d_core.guards import CONVENTIONS, GUARDS, OBSERVED
from scas4d_core.presets import PRESETS
from scas4d_core.settings import Settings
from server.settings import PREFIX, ServerSettings

DOCS = Path(__file__).parent.parent / "docs"
BEGIN, END = "<!-- settings: written by scripts/settings_pages.py -->", "<!-- end of settings -->"


def cell(value: object) -> str:
    """Returns a value as text, escaped to stay within one table cell."""
    return str(value).replace("|", "\\|").replace("\n", " ")


def default(field: FieldInfo) -> str:
    """Returns the default value of a field as it appears in the table."""
    value: Any = field.get_default(call_default_factory=True)
    if value is PydanticUndefined:
        return "required"
    if value is None or value == ():
        return "–"
    if isinstance(value, tuple):
        return f"{len(value)} of them" if isinstance(value[0], BaseModel) else ", ".join(map(str, value))
    return f"`{str(value).lower() if isinstance(value, bool) else value}`"


def server_table() -> str:
    """Returns the table of the service settings."""
    rows = ["| `SCAS4D_…`, in TOML in lower case | default | |", "|---|---|---|"]
    for name, field in ServerSettings.model_fields.items():
        rows.append(f"| `{name.upper()}` | {default(field)} | {cell(field.description)} |")
    assert PREFIX == "SCAS4D_"
    return "\n".join(rows)


def method_rows(model: type[BaseModel], path: str = "") -> Iterator[str]:
    """Yields one table row per method setting, with the parts of nested names joined by dots."""
    for name, field in model.model_fields.items():
        inner = field.annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            yield from method_rows(inner, f"{path}{name}.")
        else:
            yield f"| `{path}{name}` | {default(field)} | {cell(field.description or '')} |"


def preset_rows() -> Iterator[str]:
    """Yields one table row per preset, with the settings that the preset changes."""
    usual = Settings().model_dump(mode="json")
    for name, settings in PRESETS.items():
        changes = format_changes(settings.model_dump(mode="json"), usual)
        found = ", ".join(f"`{one}={json.dumps(value)}`" for one, value in changes.items())
        yield f"| `{name}` | {cell(found or 'nothing: the default')} |"


def method_table() -> str:
    """Returns the table of the method settings, followed by the table of the presets."""
    settings = ["| setting | default | |", "|---|---|---|", *method_rows(Settings)]
    return "\n".join([*settings, "", "| preset | changes |", "|---|---|", *preset_rows()])


def guards_table() -> str:
    """Returns the table of the guards, followed by what else is counted, and by the conventions."""
    rows = ["| guard | value | acts on | counts |", "|---|---|---|---|"]
    for guard in GUARDS.values():
        clause = guard.reason.split(":")[0].split(". ")[0].rstrip(".")
        rows.append(f"| `{guard.name}` | {guard.value:g} {guard.unit} | {clause} | {guard.counted} |")
    observed = [f"- `{name}`: {words}" for name, words in OBSERVED.items()]
    conventions = ", ".join(f"`{guard.name}`" for guard in CONVENTIONS.values())
    return "\n".join(
        [
            *rows,
            "",
            "Also counted, although they do not change the result:",
            "",
            *observed,
            "",
            f"Conventions always apply and are not counted: {conventions}.",
        ]
    )


def written(page: Path, table: str) -> str:
    """Returns the text of a page with the given table between the markers."""
    before, _, rest = page.read_text().partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n\n{table}\n\n{END}{after}"


def main() -> None:
    """Writes the pages. With `--check`, only compares them and exits with an error if one is out of date."""
    stale = []
    tables = {"service-settings.md": server_table(), "settings.md": method_table(), "stability.md": guards_table()}
    for name, table in tables.items():
        page = DOCS / name
        text = written(page, table)
        if text != page.read_text():
            stale.append(name)
            if "--check" not in sys.argv:
                page.write_text(text)
    if "--check" in sys.argv and stale:
        raise SystemExit(f"docs/{', docs/'.join(stale)}: out of date; run python scripts/settings_pages.py")
    print("written: " + ", ".join(stale) if stale else "up to date")


if __name__ == "__main__":
    main()
