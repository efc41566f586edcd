"""Export formats: names, suffixes, conventions and lost information. docs/exports.md shows them as a table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from scas4d_core.errors import InputError
from scas4d_core.exports.usd import SUFFIXES as USD_SUFFIXES

USER_AXES = "user's world, y down"
Y_UP = "y up"
WITH_PARTS = ("usd", "s4d")
"""Formats that store parts if the scene has any."""


@dataclass(frozen=True)
class Format:
    """The conventions of one format.

    Attributes:
        name: name used to select the format.
        suffixes: file suffixes; the first is used for numbered files.
        numbered: whether a sequence is written as one numbered file per frame instead of a single file.
        needs_parts, needs_rig: whether the format requires parts, or the cameras of the rig.
        accepts_ids: whether the Gaussians to export can be selected by their ids.
        axes, unit: axes and unit of positions.
        colour: colour space and encoding.
        scale, opacity: encoding, such as linear, logarithm or logit.
        shape: encoding of the covariance.
        ids: where ids are stored, or "lost".
        lost: information that a reader cannot recover.
        package: packages required in addition to those for reconstruction, or "".
    """

    name: str
    suffixes: tuple[str, ...]
    numbered: bool
    axes: str
    unit: str
    colour: str
    scale: str
    opacity: str
    shape: str
    ids: str
    lost: str
    needs_parts: bool = False
    needs_rig: bool = False
    accepts_ids: bool = False
    package: str = ""


_SPZ = Format(
    name="spz",
    suffixes=(".spz",),
    numbered=True,
    axes=Y_UP,
    unit="metre",
    colour="sRGB, harmonics to degree 3, 8 bits",
    scale="log, 8 bits (±3.2%)",
    opacity="linear, 8 bits",
    shape="quaternion (smallest three, 10 bits each), 3 scales",
    ids="lost",
    lost="scales below 45 µm or above 379 m; harmonics beyond −1…1; which Gaussians move",
    package="gsply",
)
_FORMATS = (
    Format(
        name="ply",
        suffixes=(".ply",),
        numbered=True,
        axes=USER_AXES,
        unit="user's unit",
        colour="sRGB, harmonics to degree 3, float32",
        scale="log, float32",
        opacity="logit, float32",
        shape="quaternion (w, x, y, z), 3 scales",
        ids="lost (rows keep their order)",
        lost="which Gaussians move",
    ),
    Format(
        name="splat",
        suffixes=(".splat",),
        numbered=True,
        axes=USER_AXES,
        unit="user's unit",
        colour="sRGB, degree 0, 8 bits, clipped to [0, 1]",
        scale="linear, float32",
        opacity="linear, 8 bits",
        shape="quaternion (w, x, y, z) in 8 bits each, 3 scales",
        ids="lost (rows are sorted by size · opacity)",
        lost="gloss; row order; which Gaussians move",
    ),
    _SPZ,
    Format(**{**vars(_SPZ), "name": "spz4", "package": "gsply, zstandard"}),
    Format(
        name="glb",
        suffixes=(".glb",),
        numbered=True,
        axes=Y_UP,
        unit="metre",
        colour="sRGB (`srgb_rec709_display`), harmonics to degree 3, float32; `COLOR_0` linear",
        scale="linear, float32",
        opacity="linear, float32",
        shape="quaternion (x, y, z, w), 3 scales",
        ids="attribute `_ID`",
        lost="which Gaussians move",
    ),
    Format(
        name="glb-parts",
        suffixes=(".glb",),
        numbered=False,
        axes=Y_UP,
        unit="metre; residuals in the user's unit",
        colour="as glb, from the first frame",
        scale="linear, float32",
        opacity="linear, float32",
        shape="as glb, in the part's local frame, which is animated",
        ids="attribute `_ID`",
        lost="bending within parts; Gaussians born later; changes of colour and size; highlights rotate with the part",
        needs_parts=True,
    ),
    Format(
        name="usd",
        suffixes=USD_SUFFIXES,
        numbered=False,
        axes=Y_UP,
        unit="user's unit (`metersPerUnit`)",
        colour="sRGB, harmonics to degree 3, float32; tracks linear",
        scale="linear, float32",
        opacity="linear, float32; 0 while absent",
        shape="quaternion (USD's quatf), 3 scales",
        ids="`primvars:scas4d:id`",
        lost="frame indices except the first (time codes follow the times); which Gaussians move",
        package="usd-core",
    ),
    Format(
        name="tracks",
        suffixes=(".csv",),
        numbered=False,
        axes=USER_AXES,
        unit="user's unit",
        colour="–",
        scale="–",
        opacity="–",
        shape="–",
        ids="column `id`",
        lost="everything except the centres of moving Gaussians",
        accepts_ids=True,
    ),
    Format(
        name="poses",
        suffixes=(".csv",),
        numbered=False,
        axes=USER_AXES,
        unit="user's unit",
        colour="–",
        scale="–",
        opacity="–",
        shape="–",
        ids="–",
        lost="everything except the rigid motion of the parts",
        needs_parts=True,
    ),
    Format(
        name="tapvid-mv",
        suffixes=(".zip",),
        numbered=False,
        axes=USER_AXES,
        unit="metre",
        colour="rendered images, JPEG",
        scale="–",
        opacity="–",
        shape="–",
        ids="in `scas4d.json`",
        lost="everything except images, depth, and the centres of 500 moving or given Gaussians with visibility",
        needs_rig=True,
        accepts_ids=True,
    ),
    Format(
        name="s4d",
        suffixes=(".s4d",),
        numbered=False,
        axes="y down, from the `origin` in the header",
        unit="metre; the header has `metres_per_unit`",
        colour="sRGB; gloss unchanged",
        scale="in the factor F, within the bounds in the header ([format.md](format.md))",
        opacity="linear",
        shape="the factor F, Σ = F Fᵀ, and the material rotation",
        ids="preserved",
        lost="precision, within the bounds",
    ),
)
FORMATS: Mapping[str, Format] = MappingProxyType({each.name: each for each in _FORMATS})
"""Maps each format name to its format."""

COLUMNS = ("name", "suffixes", "axes", "unit", "colour", "scale", "opacity", "shape", "ids", "lost")
"""Columns of the table in the documentation."""


def format_of(name: str) -> Format:
    """Returns the format with the given name.

    Raises:
        InputError: if there is no such format.

    >>> format_of("glb").scale
    'linear, float32'
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


def table() -> str:
    """Returns a Markdown table of the formats; formats that differ only in their names share a row.

    >>> print(table().splitlines()[0])
    | name | suffixes | sequence | axes | unit | colour | scale | opacity | shape | ids | lost |
    """
    heads = [*COLUMNS[:2], "sequence", *COLUMNS[2:]]
    names: dict[tuple[str, ...], list[str]] = {}  # names, keyed by the other cells
    for each in FORMATS.values():
        cells = {column: str(getattr(each, column)) for column in COLUMNS}
        cells["suffixes"] = " ".join(f"`{suffix}`" for suffix in each.suffixes)
        cells["sequence"] = "one file per frame" if each.numbered else "one file"
        names.setdefault(tuple(cells[head] for head in heads if head != "name"), []).append(f"`{each.name}`")
    lines = [f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
    lines += [f"| {' | '.join([', '.join(same), *cells])} |" for cells, same in names.items()]
    return "\n".join(lines)
