"""Settings written on the command line."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError


def overrides(changes: Sequence[str]) -> dict[str, Any]:
    """``["update.iterations=200"]`` to ``{"update": {"iterations": 200}}``; JSON behind the sign, else text.

    Raises:
        ValueError: no sign, or one change inside another.
    """
    result: dict[str, Any] = {}
    for change in changes:
        path, sign, text = change.partition("=")
        *groups, last = path.strip().split(".")
        if not sign or not last:
            raise ValueError(f"setting {change!r} cannot be read; write it as update.iterations=200")
        inner = result
        for group in groups:
            inner = inner.setdefault(group, {})
            if not isinstance(inner, dict):
                raise ValueError(f"setting {change!r}: {group!r} has a value already")
        try:
            inner[last] = json.loads(text)
        except json.JSONDecodeError:
            inner[last] = text.strip()
    return result


def refusal(error: ValidationError) -> str:
    """What settings that the core refused lack, as one sentence: the name, the value, the fault."""
    found = error.errors(include_url=False)
    name = ".".join(str(part) for part in found[0]["loc"])
    if found[0]["type"] == "extra_forbidden":
        fault = "there is none of this name"
    else:
        reason = found[0]["ctx"]["error"] if found[0]["type"] == "value_error" else found[0]["msg"]
        fault = f"it cannot be {found[0]['input']!r}: {reason}"
    more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    return f"setting {name}: {fault}{more}; docs/settings.md lists all"
