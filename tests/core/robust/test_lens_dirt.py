"""Dirt on a lens: a region of one image that no other camera confirms, over static content."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from box_scene import MOVING, make_box, make_rig, take_frame
from frame_cases.footage import SyntheticFootage

from scas4d_core.captures.frame import Frame
from scas4d_core.engines.cpu.renderer import CpuRenderer
from scas4d_core.engines.views import TrainingView
from scas4d_core.gaussians import Gaussians
from scas4d_core.robust import confirmed_errors
from scas4d_core.robust.confirmed_errors import CellErrors, ImageErrors
from scas4d_core.robust.lens_dirt import FEWEST_CAMERAS, SHARE, STATIC_SHARE, ShiftedRegion, shifted_region
from scas4d_core.update.view_factory import ViewFactory

RIG = make_rig()
BOX = make_box()
MIDDLE = (slice(16, 32), slice(16, 32))
BLACK = (0.0, 0.0, 0.0)


def errors_of(frame: Frame, state: Gaussians = BOX, cameras: int | None = None) -> ImageErrors:
    factory = ViewFactory(RIG)
    return ImageErrors(factory.views(frame, {})[:cameras], factory, CpuRenderer(BLACK), state)


def region_of(name: str, frame: Frame, state: Gaussians = BOX, cameras: int | None = None) -> ShiftedRegion | None:
    return shifted_region(errors_of(frame, state, cameras), name)


def with_image(frame: Frame, name: str, image: np.ndarray) -> Frame:
    return replace(frame, images={**frame.images, name: image.clip(0, 255).round().astype(np.uint8)})


def dirty(frame: Frame, name: str, white: float) -> tuple[Frame, float]:
    """Adds white (or removes light) in the middle of an image, and returns the mean change there."""
    image = frame.images[name].astype(np.float64)
    before = image.copy()
    image[MIDDLE] += white * (255 - image[MIDDLE]) if white > 0 else white * image[MIDDLE]
    return with_image(frame, name, image), float((image - before)[MIDDLE].mean() / 255)


@pytest.mark.parametrize("white", [0.2, -0.3])
def test_dirt_is_a_region_that_no_other_camera_confirms(white: float) -> None:
    frame, change = dirty(take_frame(1, 0.1, BOX, RIG), "c2", white)
    found = region_of("c2", frame, labelled(0.0))
    assert found is not None
    assert found.is_dirt
    assert 0.5 < found.level / change < 1.2
    assert region_of("c0", frame, labelled(0.0)) == ShiftedRegion(0.0, 0.0, 0.0)


def test_a_region_of_moving_content_alone_is_no_dirt() -> None:
    frame, _ = dirty(take_frame(1, 0.1, BOX, RIG), "c2", 0.3)
    static, moving = (region_of("c2", frame, labelled(label)) for label in (0.0, 1.0))
    assert static is not None
    assert moving is not None
    assert (static.share, static.level) == (moving.share, moving.level)
    assert static.static > moving.static
    assert static.is_dirt
    assert ShiftedRegion(2 * SHARE, 0.9 * STATIC_SHARE, 0.2).is_dirt is False
    assert ShiftedRegion(0.9 * SHARE, 0.5 * SHARE, 0.2).is_dirt is False


def labelled(label: float) -> Gaussians:
    return BOX.replace(foreground=np.full(len(BOX), label, np.float32))


def test_an_object_that_enters_is_no_dirt() -> None:
    visitor = BOX.rows(np.arange(MOVING))
    means = (0.5 * visitor.means + np.float32([0.0, -0.1, 0.45])).astype(np.float32)
    visitor = visitor.replace(means=means, factors=np.float32(0.5) * visitor.factors, ids=visitor.ids + len(BOX))
    found = region_of("c0", take_frame(1, 0.1, BOX.concatenate(visitor), RIG))
    assert found is not None
    assert found.share < SHARE


def test_a_small_change_of_the_whole_image_is_no_region() -> None:
    frame = take_frame(1, 0.1, BOX, RIG)
    frame = with_image(frame, "c2", 1.03 * frame.images["c2"].astype(np.float64))
    assert region_of("c2", frame) == ShiftedRegion(0.0, 0.0, 0.0)


def test_few_cameras_and_unused_cameras_are_not_searched() -> None:
    frame, _ = dirty(take_frame(1, 0.1, BOX, RIG), "c2", 0.3)
    assert region_of("c2", frame, cameras=FEWEST_CAMERAS - 1) is None
    assert region_of(RIG.names[FEWEST_CAMERAS], frame, cameras=FEWEST_CAMERAS) is None
    assert region_of("c2", frame, cameras=FEWEST_CAMERAS) is not None


def test_each_image_is_rendered_at_most_once(monkeypatch: pytest.MonkeyPatch) -> None:
    rendered: list[str] = []
    errors = confirmed_errors.cell_errors

    def count(view: TrainingView, *rest: Any) -> CellErrors:
        rendered.append(view.name)
        return errors(view, *rest)

    monkeypatch.setattr(confirmed_errors, "cell_errors", count)
    images = errors_of(take_frame(1, 0.1, BOX, RIG))
    assert rendered == []
    for name in RIG.names:
        shifted_region(images, name)
    images.credited_decibels(RIG.names)
    assert sorted(rendered) == sorted(RIG.names)


def test_slight_dirt_raises_an_alarm_in_its_third_frame(tmp_path: Path) -> None:
    footage = SyntheticFootage()
    scene, name, first = footage.start(tmp_path), footage.rig.names[2], 6
    raised: list[list[str]] = []
    for index in range(1, first + 4):
        frame = footage.frame(index)
        if index >= first:
            image = frame.images[name].astype(np.float64)
            corner = (slice(2 * len(image) // 3, None), slice(image.shape[1] // 3))
            image[corner] += 0.1 * (255 - image[corner])
            frame = with_image(frame, name, image)
        raised.append([f"{alarm.camera} {alarm.kind}" for alarm in scene.step(frame).alarms])
    assert raised == [[]] * (first - 1 + 2) + [[f"{name} camera_misfit"]] * 2
