"""``scripts/bench effects``: benefit and cost of each effect, compared with mode `auto`.

Two reconstructions start from the same frame 0 and are updated alternately, frame by frame, in one process. One uses
`auto` for every effect; in the other, some effects are pinned "on" or "off".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np

from client.cli.evaluate import DEFAULT_OPTIONS, Report, settings_record
from client.cli.scores import Column, Row
from client.importers.open_source import CaptureOptions
from scas4d_core import metrics
from scas4d_core.captures import Capture
from scas4d_core.effect_names import EFFECTS
from scas4d_core.effects.effect import effect
from scas4d_core.effects.switches import find_contradictions
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings
from scas4d_core.warm_up import compile_in_processes
from studies.captures import open_measured
from studies.quality.first_frame import first_of
from studies.quality.settings import settings_of
from studies.rows import RowStudy

Pins = Mapping[str, str]
"""Maps each effect to its mode: "on" or "off"."""

COLUMNS = (
    Column("capture", "capture"),
    Column("pinned", "pinned"),
    Column("in auto", "in_auto"),
    Column("updates", "updates", "d"),
    Column("auto dB", "psnr_auto"),
    Column("pinned − auto dB", "gain", "+.3f"),
    Column("last five", "gain_last", "+.3f"),
    Column("auto s", "seconds_auto"),
    Column("time of pinned", "seconds_ratio", ".3f"),
    Column("processor time", "cpu_ratio", ".3f"),
    Column("same bits", "same_bits"),
)


def run(
    captures: Sequence[Path],
    out: Path,
    *,
    names: Sequence[str] = (),
    pins: Sequence[Pins] = (),
    frames: int | None = None,
    changes: Sequence[str] = (),
    again: bool = False,
    options: CaptureOptions = DEFAULT_OPTIONS,
    report: Report = print,
) -> list[Row]:
    """Measures every variant of each capture, prints the table and writes it to ``out/effects.md``.

    For the arguments, see ``scripts/bench effects --help``. A second call for the same folder resumes the study.

    Returns:
        One row per capture and variant.

    Raises:
        ValueError: an effect or setting is unknown, the settings contradict a pin, or there are fewer than two frames.
    """
    if frames is not None and frames < 2:
        raise ValueError("frames must be at least 2, because effects are compared in updates")
    compile_in_processes()
    study = RowStudy(out, "effects", COLUMNS, again=again, report=report)
    settings = settings_of("scas4d", None, 0, changes)
    record = settings_record(settings, ())
    singles = variants(names or (() if pins else tuple(EFFECTS)), settings)
    for folder in captures:
        capture = open_measured(folder, options)
        count = min(frames or capture.frame_count, capture.frame_count)
        if count < 2:
            raise ValueError(f"{capture.name} has only one frame, but effects are compared in updates")
        for variant in [*singles, *pins]:
            words = ", ".join(f"{name} {mode}" for name, mode in variant.items())
            known: Row = {"capture": capture.name, "pinned": words, "settings": record}
            study.add(
                "-".join([capture.name, *(f"{name}-{mode}" for name, mode in variant.items())]),
                (record, count, *options.changed.items()),
                partial(_compared, known, capture, out, settings, variant, count),
                lambda row: f"{row['capture']}, {row['pinned']}: {row['gain']:+.2f} dB",
            )
    return study.finish()


def variants(names: Sequence[str], settings: Settings) -> list[Pins]:
    """Returns one variant for each effect and mode that the settings allow.

    For effects that are on in every scene, the only mode is "off".

    Raises:
        ValueError: an effect is unknown.

    >>> variants(["rigidity", "entering"], Settings())
    [{'rigidity': 'off'}, {'entering': 'off'}, {'entering': 'on'}]
    """
    pins: list[Pins] = []
    for name in names:
        if name not in EFFECTS:
            raise ValueError(f"unknown effect {name!r}; see docs/effects.md for the list")
        one = effect(name)
        if one.refusal(settings) is not None:
            continue
        modes = ("off", "on") if one.auto else ("off",)
        pins += [{name: mode} for mode in modes if not any(find_contradictions(pinned(settings, {name: mode})))]
    return pins


def pinned(settings: Settings, pins: Pins) -> Settings:
    """Returns the settings with the given effects pinned.

    Raises:
        ValueError: an effect or a mode is unknown.
    """
    return Settings.model_validate({**settings.model_dump(), "effects": {**settings.effects, **pins}})


def _compared(known: Row, capture: Capture, out: Path, settings: Settings, pins: Pins, count: int) -> Row:
    """Returns the measurements of a variant relative to auto."""
    given = (settings, pinned(settings, pins))
    scenes, psnr = [], np.zeros((2, count - 1))
    wall, cpu = np.zeros((2, count - 1)), np.zeros((2, count - 1))
    for one in given:
        first: dict[str, Any] = {"points": capture.points, "static": first_of(capture, out, one)}
        scenes.append(Reconstruction.start(capture.rig, capture.frame(0), one, **first))
    truth, same = capture.scaled(settings.scene.image_scale), True
    rig = truth.test_rig
    assert rig is not None
    for index in range(1, count):
        shown = truth.test_frame(index).images
        for which in (0, 1) if index % 2 else (1, 0):  # the second reconstruction finds the images in the cache
            frame = capture.frame(index)
            began, spent = perf_counter(), process_time()
            scenes[which].step(frame)
            wall[which, index - 1], cpu[which, index - 1] = perf_counter() - began, process_time() - spent
            drawn = [metrics.psnr(scenes[which].render(one, index).colour, shown[one.name]) for one in rig.cameras]
            psnr[which, index - 1] = np.mean(drawn)
        auto, other = (scene.history.newest.arrays() for scene in scenes)
        same &= auto.keys() == other.keys() and all(np.array_equal(auto[key], other[key]) for key in auto)
    timed = slice(1 if count > 2 else 0, None)  # the first update loads kernels and searches for the motion
    return known | {
        "updates": count - 1,
        "in_auto": _words(scenes[0], pins),
        "psnr_auto": float(psnr[0].mean()),
        "gain": float((psnr[1] - psnr[0]).mean()),
        "gain_last": float((psnr[1] - psnr[0])[-5:].mean()),
        "psnr_by_frame": psnr.round(3).tolist(),
        "seconds_auto": float(np.median(wall[0, timed])),
        "seconds_ratio": float(np.median(wall[1, timed] / wall[0, timed])),
        "cpu_ratio": float(cpu[1, timed].sum() / cpu[0, timed].sum()),
        "same_bits": "yes" if same else "no",
    }


def _words(scene: Reconstruction, pins: Pins) -> str:
    """Describes whether `auto` has each pinned effect switched on at the end, and since which frame."""
    record: Any = scene.history.report(scene.history.indices[-1]).get("effects", {})
    switches = {name: record[name] for name in pins if name in record}
    return ", ".join(f"on since {one['since']}" if one["on"] else "off" for one in switches.values())
