"""Writes the table of effects in docs/effects.md from the registry.

PYTHONPATH=. python scripts/effects_table.py            # writes
PYTHONPATH=. python scripts/effects_table.py --check    # exits with 1 if the page is out of date
"""

from __future__ import annotations

import sys
from pathlib import Path

from scas4d_core.effect_names import EFFECTS
from scas4d_core.effects.effect import effect

PAGE = Path(__file__).parents[1] / "docs" / "effects.md"
BEGIN, END = "<!-- effects -->\n", "<!-- end -->"
CONDITIONS = {
    "floor": "with a floor plane",
    "mask_term": "with masks",
    "shadows": "with static Gaussians; later by evidence",
    "static_colour": "no, only if pinned",
}
"""Maps an effect to the condition under which it is on by default, if that is not "yes" or "by evidence"."""


def table() -> str:
    """Returns a Markdown table with one row per effect, in registry order."""
    lines = ["| effect | group | models | on by default |", "|---|---|---|---|"]
    for one in map(effect, EFFECTS):
        on = CONDITIONS.get(one.name, "by evidence" if one.auto else "yes")
        lines.append(f"| `{one.name}` | {one.group.value} | {one.description} | {on} |")
    return "\n".join(lines) + "\n"


def written(page: str) -> str:
    """Returns the text of the page with an up-to-date table."""
    head, rest = page.split(BEGIN)
    return head + BEGIN + table() + END + rest.split(END, 1)[1]


if __name__ == "__main__":
    text = PAGE.read_text()
    if "--check" in sys.argv:
        raise SystemExit(text != written(text))
    PAGE.write_text(written(text))
