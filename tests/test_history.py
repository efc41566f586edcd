import numpy as np
import pytest

from scas4d_core.gaussians import Gaussians
from scas4d_core.history import PER_FRAME, History, HistoryError


def state(seed: int, n: int = 7) -> Gaussians:
    rng = np.random.default_rng(seed)
    rotations = rng.normal(size=(n, 4))
    return Gaussians(
        means=rng.normal(size=(n, 3)).astype(np.float32),
        factors=rng.normal(size=(n, 3, 3)).astype(np.float32),
        rotations=(rotations / np.linalg.norm(rotations, axis=1, keepdims=True)).astype(np.float32),
        opacities=np.linspace(0.1, 0.9, n, dtype=np.float32),
        colours=rng.random((n, 3)).astype(np.float32),
        foreground=rng.random(n).astype(np.float32),
        ids=np.arange(n, dtype=np.int64) + 100,
    )


def filled(history: History, frames: int = 9) -> History:
    for t in range(frames):
        history.append(2 * t, t / 30, state(t))
    return history


def same(a: Gaussians, b: Gaussians) -> bool:
    other = b.arrays()
    return all(np.array_equal(x, other[name]) and x.dtype == other[name].dtype for name, x in a.arrays().items())


@pytest.mark.parametrize("on_disk", [False, True])
def test_gives_back_what_was_committed(tmp_path, on_disk):
    history = filled(History(tmp_path / "h" if on_disk else None))
    assert history.indices == list(range(0, 18, 2))
    np.testing.assert_allclose(history.times, np.arange(9) / 30)
    for t in (0, 8, 3, 0, 5, 1, 2, 4):
        assert same(history.gaussians(2 * t), state(t))
    for name in PER_FRAME:
        stack = history.stacked(name, [4, 0, 16])
        assert np.array_equal(stack, np.stack([state(t).arrays()[name] for t in (2, 0, 8)]))


def test_load_save_and_go_on(tmp_path):
    filled(History()).save(tmp_path / "copy")
    history = History.load(tmp_path / "copy")
    history.append(40, 2.0, state(40))
    again = History.load(tmp_path / "copy")
    assert again.indices == [*range(0, 18, 2), 40]
    assert again.time(40) == 2.0
    assert same(again.gaussians(40), state(40))
    assert same(again.gaussians(6), state(3))


def test_history_on_disk_does_not_hold_every_frame(tmp_path):
    history = filled(History(tmp_path))
    for index in history.indices:
        history.gaussians(index)
    assert len(history._frames) <= 4
    assert history.indices[-1] in history._frames


def test_the_callers_arrays_stay_the_callers():
    theta = state(0)
    history = History()
    history.append(0, 0.0, theta)
    theta.means[:] = 99
    assert same(history.gaussians(0), state(0))


def test_an_interrupted_write_leaves_the_history_as_it_was(tmp_path, monkeypatch):
    history = filled(History(tmp_path), 2)

    def torn(file, **arrays):
        file.write(b"half a file")
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez", torn)
    with pytest.raises(OSError, match="disk full"):
        history.append(9, 1.0, state(9))
    monkeypatch.undo()
    assert history.indices == [0, 2]
    assert sorted(f.name for f in tmp_path.iterdir()) == ["fixed.npz", "frame_000000.npz", "frame_000002.npz"]
    history.append(9, 1.0, state(9))
    assert same(History.load(tmp_path).gaussians(9), state(9))


def test_damage_is_found_and_the_file_named(tmp_path):
    filled(History(tmp_path), 3)
    file = tmp_path / "frame_000002.npz"
    content = bytearray(file.read_bytes())
    content[200] ^= 1  # within the data of the first array, means
    file.write_bytes(content)
    with pytest.raises(HistoryError, match=r"frame_000002\.npz"):
        History.load(tmp_path).gaussians(2)


def test_refusals_name_what_is_wrong(tmp_path):
    history = filled(History(tmp_path), 2)
    with pytest.raises(HistoryError, match="frame 2 comes after frame 2"):
        history.append(2, 0.0, state(2))
    with pytest.raises(HistoryError, match="ids differ"):
        history.append(3, 0.0, state(3).replace(ids=np.arange(7)))
    with pytest.raises(HistoryError, match="means has 6 rows; give 7"):
        history.append(3, 0.0, state(3).replace(means=np.zeros((6, 3), np.float32)))
    with pytest.raises(HistoryError, match="frame 7 is not in the history; committed frames: 0 to 2"):
        history.gaussians(7)
    with pytest.raises(HistoryError, match="not kept per frame"):
        history.stacked("ids")
    with pytest.raises(HistoryError, match="already holds a history"):
        History(tmp_path)
    with pytest.raises(HistoryError, match="holds no history"):
        History.load(tmp_path / "elsewhere")
