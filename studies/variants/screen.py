"""``scripts/bench variants``: compares contenders for the default settings on variants of captures.

Every row (capture, variant, contender, seed) runs in a separate process and stays on disk. The contenders alternate row
by row, so that they are timed within the same minutes. Contenders with the same settings for frame 0 share one frame 0.
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

CONSTANTS = "scas4d_core."
"""Prefix of the changes that set a constant of the method."""


@dataclass(frozen=True)
class Contender:
    """Settings that are compared as candidates for the default.

    Attributes:
        name: name in tables.
        preset: preset that the settings start from.
        changes: changes such as ``"update.iterations=80"``.
        constants: overridden constants of the method, as pairs of dotted name and value.

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
        """Parses the name of a preset, or text of the form ``NAME: CHANGE CHANGE …``.

        The changes may include ``preset=NAME``.

        Raises:
            ValueError: the text cannot be parsed.
        """
        name, sign, rest = text.partition(":")
        if not sign:
            return cls(text.strip(), text.strip())
        given = rest.split()
        if not name.strip() or not all("=" in change for change in given):
            raise ValueError(f"invalid contender {text!r}; use the form 'longer: update.cold_start_iterations=2'")
        presets = [change.removeprefix("preset=") for change in given if change.startswith("preset=")]
        constants = [change.split("=", 1) for change in given if change.startswith(CONSTANTS)]
        changes = [c for c in given if not c.startswith((CONSTANTS, "preset="))]
        read = tuple((place, json.loads(value)) for place, value in constants)
        return cls(name.strip(), presets[-1] if presets else "scas4d", tuple(changes), read)


@dataclass(frozen=True)
class VariantJob(Job):
    """Job that measures one variant of a capture.

    Attributes:
        of: name of the variant.
    """

    of: str = "as it is"

    def open_given(self) -> Capture:
        """Returns the variant as it is passed to the method."""
        return VARIANTS[self.of].made(super().open_given())

    def open_truth(self) -> Capture:
        """Returns the variant as it is used for evaluation."""
        return VARIANTS[self.of].made(super().open_truth())

    @property
    def variant(self) -> str:
        """Name of the row without the capture, including the name of the variant."""
        return f"{super().variant}-{self.of.replace(' ', '-')}"


def run(
    captures: Sequence[Path | str],
    contenders: Sequence[Contender],
    out: Path,
    *,
    variants: Sequence[str] = (),
    seeds: Sequence[int] = (0,),
    frames: int | None = None,
    again: bool = False,
    options: CaptureOptions = DEFAULT_OPTIONS,
    report: Report = print,
) -> str:
    """Measures every contender on every variant of every capture, writes ``out/variants.md`` and returns its text.

    For the arguments, see ``scripts/bench variants --help``.

    Raises:
        ValueError: a preset or setting is unknown, or a value is out of range.
    """
    jobs, places = list[VariantJob](), list[Row]()
    for capture in captures:
        for of in variants or VARIANTS:
            for seed in seeds:
                for contender in contenders:
                    own = (*VARIANTS[of].changes, f"static.seed={seeds[0]}")
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
    return text
