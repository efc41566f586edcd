"""Settings written on the command line: NAME=VALUE to nested changes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any


def parse_changes(changes: Sequence[str] | None) -> dict[str, Any]:
    """Reads each value as JSON, else as text; None gives no changes.

    Raises:
        ValueError: a change without a sign, or one inside another.

    >>> parse_changes(["update.iterations=200", "update.clusters=[64]", "device=cuda"])
    {'update': {'iterations': 200, 'clusters': [64]}, 'device': 'cuda'}
    """
    result: dict[str, Any] = {}
    for change in changes or ():
        path, sign, text = change.partition("=")
        *groups, last = path.strip().split(".")
        if not sign or not last:
            raise ValueError(f"setting {change!r} cannot be read; write it as update.iterations=200")
        inner = result
        for group in groups:
            inner = inner.setdefault(group, {})
            if not isinstance(inner, dict):
                raise ValueError(f"setting {change!r}: {group!r} has a value already; give one of the two")
        try:
            inner[last] = json.loads(text)
        except json.JSONDecodeError:
            inner[last] = text.strip()
    return result
