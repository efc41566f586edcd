"""Settings and node labels given on the command line as NAME=VALUE."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any

import typer

from client.wire.base import check_labels

PRESETS = "scas4d, adaptive, fast, paper, dynamic3dgs, rigid, articulated, cloth, people or lights."
"""Preset names for the help texts, repeated here because `--help` does not load the presets."""
Preset = Annotated[str, typer.Option(help=PRESETS)]
Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="NAME=VALUE", help="Change a setting, such as update.iterations=200. May be repeated."
    ),
]

Labels = Annotated[
    list[str] | None,
    typer.Option(
        "--node",
        metavar="LABEL=VALUE",
        help="On a cluster, run the new scene only on nodes with this label. May be repeated.",
    ),
]


def parse_labels(labels: Sequence[str] | None) -> dict[str, str]:
    """Parses node labels; None means no labels.

    Raises:
        ValueError: a label has no `=`, has two different values, or is not a valid node label.

    >>> parse_labels(["rig=stage-a", "disk=fast"])
    {'rig': 'stage-a', 'disk': 'fast'}
    """
    result: dict[str, str] = {}
    for label in labels or ():
        name, sign, value = (part.strip() for part in label.partition("="))
        if not (name and sign and value):
            raise ValueError(f"invalid label {label!r}; use the form NAME=VALUE, such as rig=stage-a")
        if result.setdefault(name, value) != value:
            raise ValueError(f"label {name!r} is set to both {result[name]!r} and {value!r}; set it only once")
    return check_labels(result)


def parse_changes(changes: Sequence[str] | None) -> dict[str, Any]:
    """Parses settings, reading each value as JSON if possible and otherwise as text; None means no changes.

    Raises:
        ValueError: a change has no `=`, or is nested in a setting that already has a value.

    >>> parse_changes(["update.iterations=200", "update.clusters=[64]", "device=cpu"])
    {'update': {'iterations': 200, 'clusters': [64]}, 'device': 'cpu'}
    """
    result: dict[str, Any] = {}
    for change in changes or ():
        path, sign, text = change.partition("=")
        *groups, last = path.strip().split(".")
        if not sign or not last:
            raise ValueError(f"invalid setting {change!r}; use the form NAME=VALUE, such as update.iterations=200")
        inner = result
        for group in groups:
            inner = inner.setdefault(group, {})
            if not isinstance(inner, dict):
                raise ValueError(
                    f"setting {change!r} conflicts with the value set for {group!r}; set only one of the two"
                )
        try:
            inner[last] = json.loads(text)
        except json.JSONDecodeError:
            inner[last] = text.strip()
    return result


def format_changes(values: Mapping[str, Any], usual: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the settings that differ from `usual`, keyed by their dotted names.

    >>> format_changes({"update": {"iterations": 200, "seed": 0}}, {"update": {"iterations": 100, "seed": 0}})
    {'update.iterations': 200}
    """
    before = dict(_flatten(usual))
    return {name: value for name, value in _flatten(values) if before.get(name) != value}


def _flatten(values: Mapping[str, Any], under: str = "") -> Iterator[tuple[str, Any]]:
    """Flattens ``{"update": {"iterations": 100}}`` to ``("update.iterations", 100)``."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{under}{name}.")
        else:
            yield f"{under}{name}", value
