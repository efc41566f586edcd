"""Histories in which Gaussians are born, retired and revived: lives, places, damage, and frames taken back."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from histories import filled, same, state
from scipy.spatial.transform import Rotation

from scas4d_core.gaussians import Gaussians
from scas4d_core.storage.births import Life, extend_roots
from scas4d_core.storage.faults import DamagedFrameError, HistoryError
from scas4d_core.storage.history import History
from scas4d_core.storage.npz import read_npz

BORN_AT, MORE_AT, RETIRED_AT, REVIVED_AT, LAST = 2, 4, 6, 8, 10


def grown(seed: int, before: Gaussians, born: int = 0) -> Gaussians:
    """Another state of the Gaussians before, with some more."""
    count = len(before)
    drawn = state(seed, count + born)
    now = before.replace(**{name: getattr(drawn, name)[:count] for name in ("means", "factors", "rotations")})
    return now.concatenate(drawn.rows(np.arange(count, count + born))) if born else now


def fill(history: History) -> History:
    history.append(0, 0.0, state(0))
    history.append(BORN_AT, 0.1, grown(1, history.newest, 3), parents=np.array([1, -1, 6]))
    history.append(MORE_AT, 0.2, grown(2, history.newest, 2))
    history.append(RETIRED_AT, 0.3, grown(3, history.newest).retire([0, 1, 5, 8]))
    history.append(REVIVED_AT, 0.4, grown(4, history.newest).revive([1, 8]))
    history.append(LAST, 0.5, grown(5, history.newest))
    return history


INDICES = [0, BORN_AT, MORE_AT, RETIRED_AT, REVIVED_AT, LAST]
IDS = [*range(100, 107), *range(107, 110), *range(110, 112)]
LIVES = {
    100: Life(100, 0, (RETIRED_AT,)),
    101: Life(101, 0, (RETIRED_AT,), (REVIVED_AT,)),
    102: Life(102, 0),
    108: Life(108, BORN_AT, (RETIRED_AT,), (REVIVED_AT,)),
    111: Life(111, MORE_AT),
}


def check(history: History) -> None:
    assert history.indices == INDICES
    assert history.ids.tolist() == IDS
    assert (history.count, history.highest_id) == (12, 111)
    assert {life.id: life for life in history.lives(list(LIVES))} == LIVES
    assert history.born_at.tolist() == [0] * 7 + [BORN_AT] * 3 + [MORE_AT] * 2
    assert history.rows_of([108, 5, 100]).tolist() == [8, -1, 0]
    assert [len(history.gaussians(index)) for index in INDICES] == [7, 10, 12, 12, 12, 12]
    assert np.flatnonzero(~history.present(0)).tolist() == [7, 8, 9, 10, 11]
    assert np.flatnonzero(~history.present(BORN_AT)).tolist() == [10, 11]
    assert np.flatnonzero(~history.present(RETIRED_AT)).tolist() == [0, 1, 5, 8]
    assert np.flatnonzero(~history.present(LAST)).tolist() == [0, 5]
    assert history.gaussians(RETIRED_AT).opacities[8] == 0
    assert history.gaussians(LAST).opacities[8] == history.gaussians(BORN_AT).opacities[8] > 0
    np.testing.assert_array_equal(history.gaussians(LAST).retired, ~history.present(LAST))


@pytest.mark.parametrize("where", ["memory", "disk", "loaded", "copied", "saved", "refreshed"])
def test_lives(where: str, tmp_path: Path) -> None:
    if where == "memory":
        check(fill(History()))
        return
    history = History(tmp_path / "states")
    if where == "refreshed":
        history.append(0, 0.0, state(0))
        reader = History.load(tmp_path / "states")
        assert reader.count == 7
        history.append(BORN_AT, 0.1, grown(1, history.newest, 3), parents=np.array([1, -1, 6]))
        reader.refresh((BORN_AT,))
        assert reader.count == 10
        history.truncate(0)
        reader.refresh()
        assert reader.count == 7
        fill(History(tmp_path / "more"))
        shutil.rmtree(tmp_path / "states")
        shutil.move(tmp_path / "more", tmp_path / "states")
        reader.refresh()
        check(reader)
        return
    fill(history)
    if where == "saved":
        history.save(tmp_path / "copy")
    found = {
        "disk": lambda: history,
        "loaded": lambda: History.load(tmp_path / "states"),
        "copied": lambda: history.copy_frames(INDICES),
        "saved": lambda: History.load(tmp_path / "copy"),
    }[where]()
    check(found)
    for index in INDICES:
        assert same(found.gaussians(index), fill(History()).gaussians(index))


def test_without_births_nothing_more_is_written(tmp_path: Path) -> None:
    filled(History(tmp_path))
    assert not list(tmp_path.glob("born_*"))
    assert set(read_npz(tmp_path / "frame_000004.npz")) == {
        "means", "rotations", "factors", "colours", "foreground", "time", "report",
    }  # fmt: skip
    assert set(read_npz(tmp_path / "fixed.npz")) == {"opacities", "ids", "format"}


def test_a_copy_of_some_frames_knows_all_births() -> None:
    copy = fill(History()).copy_frames([0, LAST])
    assert copy.indices == [0, LAST]
    assert copy.lives([108]) == [LIVES[108]]
    copy.append(LAST + 1, 1.0, grown(7, copy.newest, 1))
    assert copy.ids[-1] == 112


def test_retention_takes_nothing_from_lives(tmp_path: Path) -> None:
    history = fill(History(tmp_path))
    assert history.retain(last=2) == [BORN_AT, MORE_AT, RETIRED_AT]
    for one in (history, History.load(tmp_path)):
        assert one.lives([108, 111]) == [LIVES[108], LIVES[111]]
        assert one.count == 12


def test_stacked_is_nan_where_one_is_not_born(tmp_path: Path) -> None:
    history = fill(History(tmp_path))
    whole = history.stacked("means")
    assert whole.shape == (6, 12, 3)
    assert np.isnan(whole[0, 7:]).all()
    assert np.isfinite(whole[2:]).all()
    some = history.stacked("means", [LAST, 0], np.array([[8, 1]]))
    np.testing.assert_array_equal(some[0, 0], whole[-1, [8, 1]])
    assert np.isnan(some[1, 0, 0]).all()
    assert np.isfinite(some[1, 0, 1]).all()
    np.testing.assert_array_equal(history.stacked("means", [LAST, 0]), whole[[-1, 0]])


def test_what_is_refused() -> None:
    history = fill(History())
    with pytest.raises(HistoryError, match="new Gaussians must have id"):
        history.append(20, 1.0, grown(1, history.newest, 1).replace(retired=None, ids=np.arange(100, 113)))
    with pytest.raises(HistoryError, match="differ from those of the first"):
        history.append(20, 1.0, history.newest.rows(np.arange(11)))


def test_the_born_go_back_as_their_founders_came() -> None:
    """A Gaussian that was there all along and one born later in its place have the same root."""
    first = state(0).replace(rotations=np.tile(np.float32([1, 0, 0, 0]), (7, 1)))
    turn, shift = Rotation.from_rotvec([0.3, -0.5, 0.2]), np.array([1.0, 2, 3])
    quaternion = np.roll(turn.as_quat(), 1).astype(np.float32)
    now = first.replace(
        means=(turn.apply(first.means) + shift).astype(np.float32),
        factors=(turn.as_matrix() @ first.factors).astype(np.float32),
        rotations=np.tile(quaternion, (7, 1)),
    )
    born = now.rows([2, 3])
    roots = extend_roots(first, now.concatenate(born).retire([1]), np.array([4, -1]))
    np.testing.assert_allclose(roots.means[7], first.means[2], atol=1e-5)
    np.testing.assert_allclose(roots.factors[7], first.factors[2], atol=1e-5)
    np.testing.assert_allclose(roots.rotations[7], [1, 0, 0, 0], atol=1e-6)
    np.testing.assert_array_equal(roots.means[8], now.means[3])
    assert np.flatnonzero(roots.retired).tolist() == [1]
    # Founders that were born themselves lead on to frame 0.
    again = extend_roots(roots, now.concatenate(born).concatenate(born).retire([1]), np.array([7, 7]))
    np.testing.assert_allclose(again.means[9], first.means[2], atol=1e-5)
    np.testing.assert_allclose(again.means[10], first.means[3], atol=1e-5)


def test_roots_are_kept(tmp_path: Path) -> None:
    history = History(tmp_path)
    history.append(0, 0.0, state(0))
    assert same(history.roots(), history.first)
    parents = np.array([1, -1, 6])
    now = grown(1, history.newest, 3)
    roots = extend_roots(history.roots(), now, parents)
    history.append(1, 0.1, now, parents=parents, roots=roots)
    history.append(2, 0.2, grown(2, history.newest).retire([0]))
    for one in (history, History.load(tmp_path), history.copy_frames([0, 1])):
        for name in ("means", "factors", "rotations", "foreground", "opacities"):
            np.testing.assert_array_equal(getattr(one.roots(1), name), getattr(roots, name))
        assert one.roots(1).ids.tolist() == IDS[:10]
        assert len(one.roots(0)) == 7
    assert History.load(tmp_path).roots().retired[0]
    assert not History.load(tmp_path).roots(1).retired.any()


def test_a_birth_taken_back_has_its_ids_again_and_no_other_gets_them(tmp_path: Path) -> None:
    for history in (History(), History(tmp_path)):
        fill(history)
        whole = [history.gaussians(index) for index in INDICES]
        assert history.truncate(0) == INDICES[1:]
        assert (history.count, history.highest_id) == (7, 111)
        history.append(BORN_AT, 0.1, grown(9, history.newest, 1))
        assert history.ids[-1] == 112
        assert history.truncate(0) == [BORN_AT]
        if history.directory is not None:
            history = History.open(tmp_path)
        history.append(1, 0.05, grown(10, history.newest, 1))
        assert history.ids[-1] == 113
        history.truncate(0)
        again = grown(1, history.newest, 3)
        history.append(BORN_AT, 0.1, again, parents=np.array([1, -1, 6]))
        assert history.ids[-3:].tolist() == [114, 115, 116]  # another birth was in its place since
        history.append(MORE_AT, 0.2, grown(2, history.newest, 2))
        assert history.ids[-2:].tolist() == [110, 111]
        assert same(history.gaussians(MORE_AT).rows([10, 11]), whole[2].rows([10, 11]))


SPOILS: dict[str, Callable[[Path], object]] = {
    "gone": lambda file: file.unlink(),
    "cut": lambda file: file.write_bytes(file.read_bytes()[:200]),
    "flipped": lambda file: file.write_bytes(bytes([*file.read_bytes()[:300], 1, *file.read_bytes()[301:]])),
}


@pytest.mark.parametrize("how", SPOILS)
@pytest.mark.parametrize("which", ["", ".copy"])
def test_a_damaged_file_of_the_born_is_read_and_written_from_the_other(how: str, which: str, tmp_path: Path) -> None:
    whole = fill(History(tmp_path))
    file = tmp_path / f"born_{BORN_AT:06d}{which}.npz"
    before = read_npz(file)
    SPOILS[how](file)
    history = History.open(tmp_path)
    check(history)
    assert same(history.gaussians(LAST), whole.gaussians(LAST))
    assert list(history.repair_fixed()) == [file.name]
    assert all(np.array_equal(array, before[name]) for name, array in read_npz(file).items())
    assert history.repair_fixed() == {}


def test_without_both_files_of_the_born_their_frames_are_damaged(tmp_path: Path) -> None:
    fill(History(tmp_path))
    for file in tmp_path.glob(f"born_{MORE_AT:06d}*"):
        file.write_bytes(b"")
    history = History.open(tmp_path)
    with pytest.raises(DamagedFrameError, match="born_000004"):
        history.gaussians(LAST)
    assert len(history.gaussians(BORN_AT)) == 10


def test_a_damaged_newest_frame_leaves_the_others_readable(tmp_path: Path) -> None:
    fill(History(tmp_path))
    (tmp_path / f"frame_{LAST:06d}.npz").write_bytes(b"")
    history = History.open(tmp_path)
    assert history.indices == INDICES[:-1]
    assert history.lives([108]) == [LIVES[108]]
    assert history.gaussians(REVIVED_AT).present[8]


def test_a_frame_is_written_anew_with_its_log(tmp_path: Path) -> None:
    whole = fill(History(tmp_path))
    arrays = whole.gaussians(BORN_AT).arrays()
    (tmp_path / f"frame_{BORN_AT:06d}.npz").write_bytes(b"")
    history = History.open(tmp_path)
    base = history.gaussians(0)
    made = history.complete_state(BORN_AT, base)
    assert len(made) == 10
    np.testing.assert_array_equal(made.means[7:], arrays["means"][7:])
    history.replace(BORN_AT, 0.1, arrays, {})
    check(history)
    check(History.load(tmp_path))
    with pytest.raises(HistoryError, match="cannot be replaced"):
        history.replace(BORN_AT, 0.1, base.arrays(), {})
