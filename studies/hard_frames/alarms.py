"""``scripts/bench alarms``: false alarms on clean variants of captures, and which planted faults are found, and when.

Every variant of a capture is updated once without faults. Each fault then replaces the images of one camera in three
consecutive frames, starting from the state before them. The cameras take turns.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from client.cli.evaluate import DEFAULT_OPTIONS, Report, settings_record
from client.cli.scores import Column, Row, markdown
from client.importers.open_source import CaptureOptions
from scas4d_core.captures import Capture
from scas4d_core.captures.frame import Frame
from scas4d_core.frame_report import FrameReport
from scas4d_core.settings import Settings
from studies.captures import open_measured
from studies.hard_frames.camera_faults import FRAMES, Picture, blurred, dirty, noisy, scaled
from studies.machine import core_version
from studies.quality.first_frame import continued, started
from studies.quality.settings import settings_of
from studies.rows import RowStudy
from studies.variants.variants import VARIANTS

AFTER = 5
"""Number of updates before the faulty frames, at most: half of the frames of a short variant."""

Plant = Callable[[Capture, int, str], tuple[Picture, Picture | None]]
"""Function that returns the faulty image of a camera in a frame of a capture, and the mask, or None without masks."""


@dataclass(frozen=True)
class Fault:
    """A planted fault of one camera.

    Attributes:
        kind: name of the fault.
        strength: its size, for tables.
        plant: function that returns the faulty image and mask.
    """

    kind: str
    strength: str
    plant: Plant


def _image(change: Callable[[Picture], Picture]) -> Plant:
    """Returns a fault that changes only the image."""

    def plant(capture: Capture, index: int, name: str) -> tuple[Picture, Picture | None]:
        image, mask = _shown(capture, index, name)
        return change(image), mask

    return plant


def _moved(share: float) -> Plant:
    """Returns a fault: a camera turned sideways, so that its image and mask shift by a share of the image width.

    The shift is a whole number of pixels, and at least one, because interpolation would also blur the image.
    """

    def plant(capture: Capture, index: int, name: str) -> tuple[Picture, Picture | None]:
        image, mask = _shown(capture, index, name)
        pixels = max(1, round(share * image.shape[1]))
        columns = np.maximum(np.arange(image.shape[1]) - pixels, 0)
        return image[:, columns], None if mask is None else mask[:, columns]

    return plant


def _late(frames: int) -> Plant:
    """Returns a fault: a camera whose images arrive ``frames`` frames late."""
    return lambda capture, index, name: _shown(capture, index - frames, name)


def _frozen(capture: Capture, index: int, name: str) -> tuple[Picture, Picture | None]:
    return _shown(capture, first_faulty(capture) - 1, name)


def _swapped(capture: Capture, index: int, name: str) -> tuple[Picture, Picture | None]:
    names = capture.full_rig.names
    return _shown(capture, index, names[(names.index(name) + 1) % len(names)])


def _shown(capture: Capture, index: int, name: str) -> tuple[Picture, Picture | None]:
    frame = capture.frame(index)
    return np.asarray(frame.images[name]), None if name not in frame.masks else np.asarray(frame.masks[name])


FAULTS = (
    Fault("moved", "0.4% of the width", _moved(0.004)),
    Fault("moved", "0.8%", _moved(0.008)),
    Fault("moved", "2%", _moved(0.02)),
    Fault("out of focus", "0.3% of the width", _image(lambda picture: blurred(picture, 0.003 * picture.shape[1]))),
    Fault("dirty", "0.2", _image(lambda picture: dirty(picture, 0.2))),
    Fault("dirty", "0.5", _image(lambda picture: dirty(picture, 0.5))),
    Fault("exposure", "0.7", _image(lambda picture: scaled(picture, 0.7))),
    Fault("white balance", "red 1.25", _image(lambda picture: scaled(picture, (1.25, 1.0, 1.0)))),
    Fault("noise", "20 levels", _image(lambda picture: noisy(picture, 20))),
    Fault("late", "1 frame", _late(1)),
    Fault("late", "3 frames", _late(3)),
    Fault("frozen", "3 frames", _frozen),
    Fault("swapped", "with its neighbour", _swapped),
)  # fmt: skip
"""The catalogue of planted faults. Lengths are fractions of the image width."""


def first_faulty(capture: Capture) -> int:
    """Returns the index of the first faulty frame."""
    return max(3, min(1 + AFTER, capture.frame_count // 2))


def run(
    captures: Sequence[Path],
    out: Path,
    *,
    variants: Sequence[str] = (),
    frames: int | None = None,
    faults: Sequence[str] = ("",),
    changes: Sequence[str] = (),
    again: bool = False,
    options: CaptureOptions = DEFAULT_OPTIONS,
    report: Report = print,
) -> list[Row]:
    """Measures every variant of every capture, and writes the tables to ``out/alarms.md``.

    For the arguments, see ``scripts/bench alarms --help``. A second call for the same folder resumes the study.

    Returns:
        One row per capture and variant.

    Raises:
        ValueError: a variant or fault is unknown.
    """
    for name in variants:
        if name not in VARIANTS:
            raise ValueError(f"unknown variant {name!r}; choose from {', '.join(VARIANTS)}")
    for part in faults:
        if not any(part in fault.kind for fault in FAULTS):
            raise ValueError(
                f"no fault contains {part!r}; choose from {', '.join({fault.kind: 0 for fault in FAULTS})}"
            )
    study = RowStudy(out, "alarms", (), again=again, report=report)
    for folder in captures:
        for variant in variants or VARIANTS:
            settings = settings_of("scas4d", None, 0, (*VARIANTS[variant].changes, *changes))
            study.add(
                f"{folder.resolve().name}-{variant.replace(' ', '-')}",
                (settings_record(settings, ()), variant, frames, tuple(faults), options.changed, core_version()),
                partial(_row, folder, variant, settings, out, frames, faults, options),
                _line,
            )
    study.write(page(study.rows))
    return study.rows


def _row(
    folder: Path,
    variant: str,
    settings: Settings,
    out: Path,
    frames: int | None,
    faults: Sequence[str],
    options: CaptureOptions,
) -> Row:
    capture = VARIANTS[variant].made(open_measured(folder, options))
    first, names = first_faulty(capture), capture.full_rig.names
    count = capture.frame_count if frames is None else min(max(frames, first + 1), capture.frame_count)
    found, clean = [], []
    with TemporaryDirectory() as place:
        scene = started(capture, settings, out, Path(place) / "clean")
        for index in range(1, count):
            if index == first:
                shutil.copytree(Path(place) / "clean", Path(place) / "before")
            clean.append(_clean(scene.step(capture.frame(index))))
        for number, fault in enumerate(FAULTS if first + FRAMES <= capture.frame_count else ()):
            if not any(part in fault.kind for part in faults):
                continue
            name = names[(number + 1) % len(names)]
            scene = continued(Path(place) / "before", Path(place) / "fault", capture.full_rig, settings)
            reports = [scene.step(_with(capture, first + n, name, fault)) for n in range(FRAMES)]
            found.append({"kind": fault.kind, "strength": fault.strength, "camera": name, **_found(reports, name)})
    identity = {"capture": capture.name, "variant": variant, "cameras": len(names)}
    return {**identity, "clean": clean, "faults": found}


def _with(capture: Capture, index: int, name: str, fault: Fault) -> Frame:
    frame = capture.frame(index)
    image, mask = fault.plant(capture, index, name)
    masks = {other: known for other, known in frame.masks.items() if other != name}
    if mask is not None:
        masks[name] = mask
    return Frame(frame.index, frame.time, {**frame.images, name: image}, masks)


def _clean(report: FrameReport) -> dict[str, Any]:
    return {
        "index": report.index,
        "rejected": report.outcome.rejected,
        "excluded": sorted(report.dropped),
        "alarms": [asdict(alarm) for alarm in report.alarms],
    }


def _found(reports: Sequence[FrameReport], name: str) -> dict[str, Any]:
    """Returns the number of the first faulty frame with an alarm for the camera, the kinds, and other alarms."""
    raised = [[alarm for alarm in report.alarms if alarm.camera == name] for report in reports]
    return {
        "by": next((number for number, alarms in enumerate(raised, 1) if alarms), None),
        "kinds": sorted({alarm.kind for alarms in raised for alarm in alarms}),
        "others": [
            f"{report.index} {alarm.camera or 'frame'} {alarm.kind}: {alarm.evidence}"
            for report in reports
            for alarm in report.alarms
            if alarm.camera != name
        ],
        "rejected": sum(report.outcome.rejected for report in reports),
    }


def _line(row: Row) -> str:
    clean, missed = row["clean"], [fault for fault in row["faults"] if fault["by"] is None]
    lines = [
        f"{row['capture']}, {row['variant']}: {len(clean)} clean updates, "
        f"{len(_camera_alarms(row))} false alarms, {sum(frame['rejected'] for frame in clean)} rejected; "
        f"{len(row['faults']) - len(missed)} of {len(row['faults'])} faults found"
    ]
    lines += [
        f"  ! {alarm['index']} {alarm['camera']} {alarm['kind']}: {alarm['evidence']}" for alarm in _camera_alarms(row)
    ]
    lines += [f"  missed: {fault['kind']} {fault['strength']} ({fault['camera']})" for fault in missed]
    lines += [
        f"  other alarm during {fault['kind']} {fault['strength']} ({fault['camera']}): {other}"
        for fault in row["faults"]
        for other in fault["others"]
    ]
    return "\n".join(lines)


def _camera_alarms(row: Row) -> list[dict[str, Any]]:
    """Returns the alarms of single cameras in frames without faults; all of them are false."""
    return [
        {"index": frame["index"], **alarm} for frame in row["clean"] for alarm in frame["alarms"] if alarm["camera"]
    ]


CLEAN = (
    Column("capture", "capture"),
    Column("variant", "variant"),
    Column("updates × cameras", "images", "d"),
    Column("false alarms of cameras", "alarms", "d"),
    Column("good cameras left out", "excluded", "d"),
    Column("frames rejected", "rejected", "d"),
)
PLANTED = (
    Column("fault", "kind"),
    Column("strength", "strength"),
    Column("planted", "planted", "d"),
    Column("found in the first frame", "first", "d"),
    Column("by the third", "third", "d"),
    Column("other alarms", "others", "d"),
)


def page(rows: Sequence[Row]) -> str:
    """Returns the tables of clean variants and of planted faults."""
    clean = [
        {
            "capture": row["capture"],
            "variant": row["variant"],
            "images": row["cameras"] * len(row["clean"]),
            "alarms": len(_camera_alarms(row)),
            "excluded": sum(len(frame["excluded"]) for frame in row["clean"]),
            "rejected": sum(frame["rejected"] for frame in row["clean"]),
        }
        for row in rows
    ]
    total: Row = {name: sum(line[name] for line in clean) for name in ("images", "alarms", "excluded", "rejected")}
    planted = []
    for fault in FAULTS:
        of = [f for row in rows for f in row["faults"] if (f["kind"], f["strength"]) == (fault.kind, fault.strength)]
        planted.append(
            {
                "kind": fault.kind,
                "strength": fault.strength,
                "planted": len(of),
                "first": sum(f["by"] == 1 for f in of),
                "third": sum(f["by"] is not None for f in of),
                "others": sum(len(f["others"]) for f in of),
            }
        )
    return "\n\n".join((markdown([*clean, {"capture": "all", **total}], CLEAN), markdown(planted, PLANTED)))
