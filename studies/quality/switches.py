"""``scripts/bench switches``: the effects that a stream activates, and how often each is switched on or off.

Captures are played back and forth, so a stream can be longer than its capture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from client.cli.evaluate import Report, settings_record
from client.cli.scores import Column, Row, digest, kept_row, markdown
from client.importers.open_source import open_source
from scas4d_core.captures import Capture
from scas4d_core.captures.frame import Frame
from scas4d_core.effect_names import EFFECTS
from scas4d_core.effects.effect import effect
from scas4d_core.settings import Settings
from studies.machine import core_version, machine
from studies.quality.first_frame import started
from studies.quality.settings import settings_of

COLUMNS = (
    Column("capture", "capture"),
    Column("seed", "seed", "d"),
    Column("updates", "updates", "d"),
    Column("on at the end", "on"),
    Column("switches after frame 0", "switches"),
    Column("of one effect", "most", "d"),
)


def run(
    captures: Sequence[Path],
    out: Path,
    *,
    updates: int = 50,
    preset: str = "scas4d",
    seeds: Sequence[int] = (0,),
    changes: Sequence[str] = (),
    again: bool = False,
    report: Report = print,
) -> list[Row]:
    """Updates each capture for a number of frames, prints the table and writes it to ``out/switches.md``.

    Args:
        captures: capture folders.
        out: study folder, which stores each finished run; a second call resumes the study.
        updates: updates per capture.
        preset: settings preset.
        seeds: seeds for frame 0 and the updates; every seed is measured.
        changes: changes to the settings.
        again: whether to repeat finished runs.
        report: callback that prints progress messages.

    Returns:
        One row per capture and seed.
    """
    rows = []
    for folder in captures:
        for seed in seeds:
            settings = settings_of(preset, None, seed, changes)
            path = (
                out
                / "switches"
                / f"{folder.resolve().name}-s{seed}-{digest(settings_record(settings, ()), updates)}.json"
            )
            row = kept_row(path, partial(_row, folder, out, path.stem, settings, seed, updates), again=again)
            report(f"{row['capture']}, seed {seed}: {row['switches']}")
            rows.append(row)
    table = markdown(rows, COLUMNS)
    (out / "switches.md").write_text(table + "\n")
    report(table)
    return rows


def _row(folder: Path, out: Path, key: str, settings: Settings, seed: int, updates: int) -> Row:
    return {
        "key": key,
        "seed": seed,
        **_played(open_source(folder), out, settings, updates),
        "settings": settings_record(settings, ()),
        "core": core_version(),
        "machine": machine(),
    }


def _played(capture: Capture, out: Path, settings: Settings, updates: int) -> Row:
    """Plays a capture and returns when effects that need evidence were switched on or off."""
    scene = started(capture, settings, out)
    auto = [name for name in EFFECTS if effect(name).auto]
    on = [{name: bool(scene.history.report(0)["effects"].get(name, {}).get("on")) for name in auto}]
    changed: dict[str, list[int]] = {}
    for index in range(1, updates + 1):
        scene.step(played(capture, index))
        switches = scene.history.report(index)["effects"]
        on.append({name: bool(switches.get(name, {}).get("on")) for name in auto})
        for name in auto:
            if on[-1][name] != on[-2][name]:
                changed.setdefault(name, []).append(index)
    return {
        "capture": capture.name,
        "updates": updates,
        "on": ", ".join(name for name in auto if on[-1][name]) or "none",
        "switches": ", ".join(f"{name} at {', '.join(map(str, at))}" for name, at in changed.items()) or "none",
        "most": max(map(len, changed.values()), default=0),
        "by_frame": {name: [frame[name] for frame in on] for name in auto},
    }


def played(capture: Capture, index: int) -> Frame:
    """Returns frame ``index`` of a capture that is played back and forth endlessly.

    >>> capture = open_source("samples/robot")
    >>> last = capture.frame_count - 1
    >>> back = played(capture, last + 1)
    >>> back.index == last + 1, sorted(back.images) == sorted(capture.frame(last - 1).images)
    (True, True)
    """
    last = capture.frame_count - 1
    turn = index % max(1, 2 * last)
    return replace(capture.frame(min(turn, 2 * last - turn)), index=index, time=index / capture.fps)
