"""``scripts/bench variants``: contenders for the default, on variants of captures.

Every row (capture, variant, contender, seed) runs in a process of its own and stays on disk, as those of
``scripts/bench quality``; contenders follow one another row by row, so that their seconds are of the same minutes, and
share frame 0 wherever their settings of it are the same.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from client.cli.evaluate import DEFAULT_OPTIONS, Job, Report
from client.cli.scores import Row
from client.importers.open_source import CaptureOptions
from scas4d_core.captures import Capture
from studies.quality.quality import run_jobs
from studies.quality.settings import settings_of
from studies.variants.page import page
from studies.variants.variants import VARIANTS

QUICK = ("half the pixels", "backwards", "every second", "half the cameras")
"""The variants of the screen: all at half the pixels."""
QUICK_FRAMES = 7
"""Frames of the screen: the first updates, in which most is decided."""
QUICK_CHANGES = ("scene.image_scale=0.5",)
CONSTANTS = "scas4d_core."
"""What a change begins with that gives a constant of the method another value."""


@dataclass(frozen=True)
class Contender:
    """Settings that compete for the default.

    Attributes:
        name: for tables. preset: that it starts from. changes: settings as ``"update.iterations=80"``.
        constants: of the method, by dotted name.

    >>> Contender.read("seeded: update.seed=2 scas4d_core.update.warm_start.WARM_START=0.5")
    Contender(name='seeded', preset='scas4d', changes=('update.seed=2',), constants=(('scas4d_core...', 0.5),))
    >>> Contender.read("adaptive").preset
    'adaptive'
    """

    name: str
    preset: str = "scas4d"
    changes: tuple[str, ...] = ()
    constants: tuple[tuple[str, Any], ...] = ()

    @classmethod
    def read(cls, text: str) -> Contender:
        """Parses ``NAME`` of a preset, or ``NAME: CHANGE CHANGE …``; ``preset=NAME`` is one of the changes.

        Raises:
            ValueError: it cannot be read.
        """
        name, sign, rest = text.partition(":")
        if not sign:
            return cls(text.strip(), text.strip())
        given = rest.split()
        if not name.strip() or not all("=" in change for change in given):
            raise ValueError(f"contender {text!r} cannot be read; write it as 'longer: update.cold_start_iterations=2'")
        presets = [change.removeprefix("preset=") for change in given if change.startswith("preset=")]
        constants = [change.split("=", 1) for change in given if change.startswith(CONSTANTS)]
        changes = [c for c in given if not c.startswith((CONSTANTS, "preset="))]
        read = tuple((place, json.loads(value)) for place, value in constants)
        return cls(name.strip(), presets[-1] if presets else "scas4d", tuple(changes), read)


@dataclass(frozen=True)
class VariantJob(Job):
    """A row of a variant.

    Attributes:
        of: the variant's name.
    """

    of: str = "as it is"

    def open_given(self) -> Capture:
        """Returns the variant as input of the method."""
        return VARIANTS[self.of].made(super().open_given())

    def open_truth(self) -> Capture:
        """Returns the variant as it is measured."""
        return VARIANTS[self.of].made(super().open_truth())

    @property
    def variant(self) -> str:
        """Names the row without its capture; the variant is part of the name."""
        return f"{super().variant}-{self.of.replace(' ', '-')}"


def run(
    captures: Sequence[Path | str],
    contenders: Sequence[Contender],
    out: Path,
    *,
    variants: Sequence[str] = (),
    seeds: Sequence[int] = (0,),
    frames: int | None = None,
    quick: bool = False,
    again: bool = False,
    options: CaptureOptions = DEFAULT_OPTIONS,
    report: Report = print,
) -> str:
    """Measures every contender on every variant of every capture; returns the page and writes ``out/variants.md``.

    Args:
        captures: folders. contenders: the first is what the others are compared with.
        out: rows and frames 0 go here; run again with the same folder to go on.
        variants: names out of ``VARIANTS``; none: all, or those of the screen.
        seeds: of the updates; frame 0 has the first in all.
        frames: at most so many. quick: the screen, see ``QUICK``. again: measure rows anew that are on disk.
        options: how the captures are read. report: takes the lines that are printed.

    Raises:
        ValueError: an unknown preset or setting, or a value out of range.
    """
    variants = variants or (QUICK if quick else tuple(VARIANTS))
    frames = frames or (QUICK_FRAMES if quick else None)
    jobs, places = list[VariantJob](), list[Row]()
    for capture in captures:
        for of in variants:
            for seed in seeds:
                for contender in contenders:
                    own = (*VARIANTS[of].changes, *(QUICK_CHANGES if quick else ()), f"static.seed={seeds[0]}")
                    settings = settings_of(contender.preset, None, seed, (*own, *contender.changes))
                    job = VariantJob(
                        Path(capture), contender.preset, settings, frames, pictures=(), options=options,
                        constants=contender.constants, of=of,
                    )  # fmt: skip
                    jobs.append(job)
                    places.append({"of": of, "contender": contender.name, "seed": seed})
    measured = run_jobs(jobs, out, again=again, report=report)
    text = page([row | place for row, place in zip(measured, places, strict=True)], [one.name for one in contenders])
    (out / "variants.md").write_text(text + "\n")
    report(text)
    return text
