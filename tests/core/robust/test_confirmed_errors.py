"""Errors that other cameras confirm: new objects do, and faults of one camera do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from box_scene import MOVING, look_at, make_box, make_rig, moved, take_frame
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import Rig
from scas4d_core.captures.frame import Frame
from scas4d_core.engines.cpu.renderer import CpuRenderer
from scas4d_core.gaussians import Gaussians
from scas4d_core.robust.confirmed_errors import (
    CellErrors,
    ImageErrors,
    cell_errors,
    confirmed_cells,
    ray_depths,
)
from scas4d_core.update.view_factory import ViewFactory

RIG = make_rig()
BOX = make_box()
ENTERED = [0.0, -0.1, 0.45]  # between the box and c0, which sees it larger than the other cameras do


def with_visitor(centre: list[float], scale: float = 0.5) -> Gaussians:
    """The box and a smaller copy of it, which no state contains."""
    visitor = BOX.rows(np.arange(MOVING))
    means = (scale * visitor.means + np.float32(centre)).astype(np.float32)
    visitor = visitor.replace(means=means, factors=np.float32(scale) * visitor.factors, ids=visitor.ids + len(BOX))
    return BOX.concatenate(visitor)


def credits_of(frame: Frame, names: list[str], rig: Rig = RIG) -> dict[str, float]:
    factory = ViewFactory(rig)
    images = ImageErrors(factory.views(frame, {}), factory, CpuRenderer((0, 0, 0)), BOX)
    return images.credited_decibels(names)


def error_of(frame: Frame, name: str, rig: Rig = RIG) -> float:
    factory = ViewFactory(rig)
    (view,) = (view for view in factory.views(frame, {}) if view.name == name)
    return CpuRenderer((0, 0, 0)).compare(BOX, [view])[0].psnr


def test_an_object_that_enters_is_confirmed() -> None:
    frame = take_frame(1, 0.1, with_visitor(ENTERED), RIG)
    assert error_of(frame, "c0") < 22
    assert credits_of(frame, ["c0"])["c0"] > 5


def test_an_object_that_most_images_show_only_in_part_is_confirmed_as_a_whole() -> None:
    near = [0.0, 0.05, 0.55]  # the neighbours see half of it
    frame = take_frame(1, 0.1, with_visitor(near), RIG)
    assert credits_of(frame, ["c0"])["c0"] > 5


@pytest.mark.parametrize("fault", ["moved", "dirty", "late", "another camera's image"])
def test_a_fault_of_one_camera_is_not_confirmed(fault: str) -> None:
    frame = take_frame(1, 0.1, BOX, RIG)
    image = frame.images["c2"].copy()
    if fault == "moved":
        image = np.roll(image, 3, axis=1)
    elif fault == "dirty":
        image[16:32, 16:32] = 200
    elif fault == "late":
        other = take_frame(0, 0.0, moved(BOX, Rotation.from_rotvec([0, 0.3, 0]), np.array([0.1, 0, 0])), RIG)
        image = other.images["c2"]
    else:
        image = frame.images["c5"]
    frame = replace(frame, images={**frame.images, "c2": image})
    assert error_of(frame, "c2") < 24
    assert credits_of(frame, ["c2"])["c2"] < 0.5


def test_a_fault_is_found_beside_an_object_that_enters() -> None:
    frame = take_frame(1, 0.1, with_visitor(ENTERED), RIG)
    frame = replace(frame, images={**frame.images, "c3": np.roll(frame.images["c3"], 4, axis=1)})
    credits = credits_of(frame, ["c0", "c3"])
    assert credits["c0"] > 5
    assert credits["c3"] < 1.5


def test_two_cameras_cannot_confirm_each_other() -> None:
    """A point needs two witnesses besides the camera."""
    pair = Rig(RIG.cameras[:2])
    frame = take_frame(1, 0.1, with_visitor(ENTERED), pair)
    assert credits_of(frame, ["c0"], pair)["c0"] == 0


def test_without_errors_nothing_is_credited() -> None:
    assert credits_of(take_frame(1, 0.1, BOX, RIG), ["c1", "c4"]) == pytest.approx({"c1": 0, "c4": 0}, abs=0.05)


def test_a_camera_without_an_image_is_not_measured() -> None:
    frame = take_frame(1, 0.1, BOX, Rig(RIG.cameras[1:]))
    assert set(credits_of(frame, ["c0", "c1"])) == {"c1"}


def test_a_camera_that_sees_no_gaussian_confirms_nothing() -> None:
    away = look_at("away", [0.0, 0.0, 30.0])
    turned = replace(away, world_to_camera=np.diag([-1.0, 1, -1, 1]) @ away.world_to_camera)
    assert ray_depths(turned, BOX).size == 0
    cells = np.zeros((24, 24), np.float32)
    cells[5, 5] = 1
    quiet = {
        name: CellErrors(
            np.full((24, 24), 1e-4, np.float32), np.zeros((24, 24), np.float32), np.ones((24, 24), np.bool_), 1e-4, 2.0
        )
        for name in RIG.names
    }
    rig = Rig((*RIG.cameras, turned))
    own = CellErrors(cells, np.zeros_like(cells), np.ones(cells.shape, np.bool_), 0.0, 2.0)
    assert not confirmed_cells("away", own, quiet, rig, ray_depths(turned, BOX)).any()


@pytest.mark.parametrize("size", [(48, 48), (53, 37), (300, 193)])
def test_cells_cover_the_image_at_any_size(size: tuple[int, int]) -> None:
    """A single erroneous pixel lies in the cell that its position in pixels of the camera belongs to."""
    width, height = size
    lens = np.array([[60.0, 0, width / 2], [0, 60, height / 2], [0, 0, 1]])
    camera = replace(RIG["c0"], intrinsics=lens, width=width, height=height)
    factory = ViewFactory(Rig((camera,)))
    image = take_frame(1, 0.1, BOX, Rig((camera,))).images["c0"].copy()
    column, row = width - 6, height - 7
    image[row - 2 : row + 3, column - 2 : column + 3] = 255
    (view,) = factory.views(Frame(1, 0.1, {"c0": image}, {}), {})
    errors = cell_errors(view, factory, CpuRenderer((0, 0, 0)), BOX)
    worst = np.unravel_index(errors.squares.argmax(), errors.squares.shape)
    assert np.abs(np.array(worst) - np.array([row, column]) / errors.edge).max() <= 1.5
