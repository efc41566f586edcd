"""Export formats: names, suffixes and requirements. docs/exports.md lists their conventions and what they lose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from scas4d_core.errors import InputError
from scas4d_core.exports.usd import SUFFIXES as USD_SUFFIXES

WITH_PARTS = ("usd", "s4d")
"""Formats that store parts if the scene has any."""


@dataclass(frozen=True)
class Format:
    """Name, suffixes and requirements of an export format.

    Attributes:
        name: name used to select the format.
        suffixes: file suffixes; the first is used for numbered files.
        numbered: whether a sequence is written as one numbered file per frame instead of a single file.
        needs_parts, needs_rig: whether the format requires parts, or the cameras of the rig.
        accepts_ids: whether the Gaussians to export can be selected by their ids.
    """

    name: str
    suffixes: tuple[str, ...]
    numbered: bool = False
    needs_parts: bool = False
    needs_rig: bool = False
    accepts_ids: bool = False


_FORMATS = (
    Format("ply", (".ply",), numbered=True),
    Format("splat", (".splat",), numbered=True),
    Format("spz", (".spz",), numbered=True),
    Format("spz4", (".spz",), numbered=True),
    Format("glb", (".glb",), numbered=True),
    Format("glb-parts", (".glb",), needs_parts=True),
    Format("usd", USD_SUFFIXES),
    Format("tracks", (".csv",), accepts_ids=True),
    Format("poses", (".csv",), needs_parts=True),
    Format("tapvid-mv", (".zip",), needs_rig=True, accepts_ids=True),
    Format("s4d", (".s4d",)),
)
FORMATS: Mapping[str, Format] = MappingProxyType({each.name: each for each in _FORMATS})
"""Maps each format name to its format."""


def format_of(name: str) -> Format:
    """Returns the format with the given name.

    Raises:
        InputError: if there is no such format.

    >>> format_of("glb").suffixes
    ('.glb',)
    >>> format_of("obj")
    Traceback (most recent call last):
    scas4d_core.errors.InputError: unknown format 'obj'; choose from ply, splat, spz, spz4, glb, glb-parts, usd, ...
    """
    if name not in FORMATS:
        raise InputError(f"unknown format {name!r}", f"choose from {', '.join(FORMATS)}")
    return FORMATS[name]


def formats_with_ids() -> list[str]:
    """Returns the names of the formats for which Gaussians can be selected by their ids.

    >>> formats_with_ids()
    ['tracks', 'tapvid-mv']
    """
    return [name for name, each in FORMATS.items() if each.accepts_ids]


def check_suffix(path: Path, format: Format) -> None:
    """Checks that the path of a single output file has a valid suffix for the format.

    Raises:
        InputError: if the suffix does not belong to the format.

    >>> check_suffix(Path("a.txt"), FORMATS["tracks"])
    Traceback (most recent call last):
    scas4d_core.errors.InputError: out 'a.txt' has the wrong suffix for format 'tracks'; use .csv
    """
    if path.suffix.lower() not in format.suffixes:
        raise InputError(
            f"out {str(path)!r} has the wrong suffix for format {format.name!r}",
            f"use {' or '.join(format.suffixes)}",
        )
