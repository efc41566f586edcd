"""Gaussians that are appended, retired and revived: rows stay, and what is retired is neither drawn nor moves."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from box_scene import MOVING, make_box, make_rig, photograph
from numpy.typing import NDArray

from scas4d_core.gaussians import FIXED, PER_FRAME, WHOLE, Gaussians, moving_extent

BOX = make_box()


def assert_same(one: Gaussians, other: Gaussians) -> None:
    assert one.arrays().keys() == other.arrays().keys()
    for name, array in one.arrays().items():
        np.testing.assert_array_equal(array, other.arrays()[name], err_msg=name)


def test_without_any_retired_the_arrays_are_as_ever() -> None:
    names = ["means", "factors", "rotations", "opacities", "colours", "foreground", "ids"]
    assert sorted(BOX.arrays()) == sorted(names)
    assert sorted((*PER_FRAME, *FIXED)) == sorted(names)
    assert BOX.opacities is BOX.own_opacities
    assert not BOX.retired.any()
    assert BOX.present.all()


def test_born_are_appended_without_ids() -> None:
    born = BOX.rows([3, 5])
    grown = BOX.concatenate(born)
    assert len(grown) == len(BOX) + 2
    assert_same(grown.rows(np.arange(len(BOX))), BOX)
    assert grown.ids[-2:].tolist() == [-1, -1]
    assert born.ids.tolist() == [3, 5]
    for name in PER_FRAME:
        np.testing.assert_array_equal(getattr(grown, name)[-2:], getattr(BOX, name)[[3, 5]])


def test_retired_ones_are_not_drawn_and_do_not_move() -> None:
    box = np.arange(len(BOX)) < MOVING
    gone = BOX.retire(np.flatnonzero(box))
    assert not gone.moving.any()
    assert len(gone) == len(BOX)
    camera = make_rig().cameras[0]
    plate = BOX.rows(~box)
    np.testing.assert_array_equal(photograph(gone, camera)[0], photograph(plate, camera)[0])
    assert moving_extent(gone) == moving_extent(plate.replace(foreground=np.zeros(len(plate), np.float32)))
    back = gone.revive(box)
    assert_same(back, BOX)
    np.testing.assert_array_equal(back.opacities, BOX.opacities)
    assert_same(BOX.retire([]), BOX)


def test_retired_ones_keep_what_is_their_own() -> None:
    gone = BOX.retire([1])
    assert gone.opacities[1] == 0
    assert gone.own_opacities[1] == BOX.opacities[1]
    again = Gaussians(**gone.arrays())
    assert_same(again, gone)
    np.testing.assert_array_equal(again.opacities, gone.opacities)
    thin = gone.replace(opacities=np.full(len(BOX), 0.5, np.float32))
    assert thin.opacities[:3].tolist() == [0.5, 0.0, 0.5]
    assert thin.revive([1]).opacities[1] == 0.5
    assert gone.replace(means=BOX.means + 1).retired[1]


def test_pickles_are_the_same_states() -> None:
    assert_same(pickle.loads(pickle.dumps(BOX)), BOX)
    gone = pickle.loads(pickle.dumps(BOX.retire([2])))
    assert_same(gone, BOX.retire([2]))
    np.testing.assert_array_equal(gone.opacities, BOX.retire([2]).opacities)


@dataclass(frozen=True, eq=False)
class Lit(Gaussians):
    """With a field that has no row per Gaussian."""

    light: NDArray[Any] | None = field(default=None, metadata=WHOLE)


def test_a_field_without_rows_is_carried_whole() -> None:
    light = np.arange(12, dtype=np.float32)
    lit = Lit(**BOX.arrays(), light=light)
    assert lit.rows([0, 1]).light is light  # type: ignore[attr-defined]
    assert lit.concatenate(BOX).light is light  # type: ignore[attr-defined]
    assert lit.retire([0]).arrays()["light"] is light
    assert "light" not in Lit(**BOX.arrays()).arrays()
