"""A grey camera among colour cameras: the report of frame 0 names it, whoever has sent the pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from box_scene import make_box, make_rig, take_frame

from scas4d_core.captures.frame import Frame, InitialPoints
from scas4d_core.captures.images import grey_among
from scas4d_core.frame_outcome import first_warnings
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings, StaticSettings, UpdateSettings

RIG, BOX = make_rig(), make_box()
NAMES = RIG.names


def greyed(frame: Frame, *names: str) -> Frame:
    """The frame with grey pictures of some cameras."""
    images = dict(frame.images)
    for name in names:
        luminance = np.rint(images[name] @ [0.299, 0.587, 0.114]).astype(np.uint8)
        images[name] = np.repeat(luminance[..., None], 3, axis=2)
    return replace(frame, images=images)


def test_it_is_named_in_the_report_and_in_a_warning() -> None:
    points = InitialPoints(BOX.means.astype(np.float64), BOX.colours, None)
    settings = Settings(static=StaticSettings(iterations=2), update=UpdateSettings(iterations=2))
    frames = [greyed(take_frame(index, index / 30, BOX, RIG), NAMES[1]) for index in range(2)]
    scene = Reconstruction.start(RIG, frames[0], settings, points=points)
    assert scene.report is not None
    assert scene.report.grey == [NAMES[1]]
    told = [sentence for sentence in scene.report.warnings if sentence.startswith("grayscale cameras")]
    assert len(told) == 1
    assert f"colour ones: {NAMES[1]}; " in told[0]
    assert told[0] in first_warnings(scene.history.report(0))
    assert scene.step(frames[1]).grey == []  # it is said once


def test_only_grey_beside_colours_is_told() -> None:
    frame = take_frame(0, 0.0, BOX, RIG)
    assert grey_among(frame.images) == []
    assert grey_among(greyed(frame, *NAMES).images) == []
    assert grey_among(greyed(frame, NAMES[0], NAMES[2]).images) == [NAMES[0], NAMES[2]]
    covered = {**frame.images, NAMES[0]: np.full_like(frame.images[NAMES[0]], 7)}
    assert grey_among(covered) == []  # of a lens with its cap on nothing can be told
    assert grey_among({}) == []
