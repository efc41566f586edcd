"""The two formats in the user's axes, read by plyfile and by plain numpy."""

import numpy as np
import pytest
from export_cases import corner
from plyfile import PlyData

from scas4d_core.errors import InputError
from scas4d_core.exports.splat import ROW, write_splat
from scas4d_core.gaussians import Gaussians
from scas4d_core.query.ply import write_ply

C0 = 0.28209479177387814


def sorted_rows(state):
    """Rows as the file has them: large and opaque ones first."""
    size = np.sqrt(np.linalg.det(corner.wanted(state).covariances)) * state.opacities
    return np.argsort(-size)


def test_ply_by_plyfile(tmp_path):
    state = corner.state()
    write_ply(tmp_path / "a.ply", state, corner.WORLD)
    vertex = PlyData.read(str(tmp_path / "a.ply"))["vertex"]

    def column(*names):
        return np.stack([np.asarray(vertex[name], np.float64) for name in names], axis=-1)

    found = corner.Found(
        column("x", "y", "z"),
        corner.covariances(column("rot_1", "rot_2", "rot_3", "rot_0"), np.exp(column("scale_0", "scale_1", "scale_2"))),
        0.5 + C0 * column("f_dc_0", "f_dc_1", "f_dc_2"),
        1 / (1 + np.exp(-np.asarray(vertex["opacity"], np.float64))),
    )
    corner.assert_same(
        found, corner.wanted(state), means=2e-5, covariances=3e-6, colours=1e-6, opacities=1e-6
    )  # fmt: skip


def test_splat_by_numpy(tmp_path):
    state = corner.state()
    write_splat(tmp_path / "a.splat", state, corner.WORLD)
    content = (tmp_path / "a.splat").read_bytes()
    assert len(content) == 32 * corner.COUNT
    floats = np.frombuffer(content, "<f4").reshape(-1, 8)
    numbers = np.frombuffer(content, np.uint8).reshape(-1, 32)
    w, x, y, z = (numbers[:, 28:].T.astype(np.float64) - 128) / 128
    found = corner.Found(
        floats[:, :3].astype(np.float64),
        corner.covariances(np.stack([x, y, z, w], axis=1), floats[:, 3:6]),
        numbers[:, 24:27] / 255,
        numbers[:, 27] / 255,
    )
    truth = corner.wanted(state).rows(sorted_rows(state))
    corner.assert_same(found, truth, means=2e-5, covariances=0.02, colours=0.5 / 254, opacities=0.5 / 254)


def test_splat_holds_no_rotation_at_all_exactly(tmp_path):
    """+1 has no byte; readers that do not normalize would make 255 a little less than one."""
    write_splat(tmp_path / "a.splat", Gaussians.of_points([[0, 0, 1]], radius=0.1), corner.WORLD)
    assert list((tmp_path / "a.splat").read_bytes()[28:]) == [0, 128, 128, 128]


def test_splat_of_gloss_has_the_mean_colour_and_none_of_the_retired(tmp_path):
    state = corner.state(gloss=True).retire([2, 7])
    write_splat(tmp_path / "a.splat", state, corner.WORLD)
    left = state.rows(state.present)
    colours = corner.wanted(left).colours
    assert np.abs(colours - left.colours).max() > 0.05  # gloss shows
    back = np.fromfile(tmp_path / "a.splat", ROW)["rgba"][:, :3] / 255
    np.testing.assert_allclose(back, np.clip(colours[sorted_rows(left)], 0, 1), atol=0.5 / 254)


def test_splat_that_cannot_be_written(tmp_path):
    with pytest.raises(InputError, match=r"out '.*a\.splat' cannot be written"):
        write_splat(tmp_path / "no" / "a.splat", corner.state(), corner.WORLD)
    state = corner.state()
    broken = state.replace(means=np.where(np.arange(10)[:, None] == 3, np.nan, state.means))
    with pytest.raises(InputError, match=r"rows \[3\], ids \[53\]"):
        write_splat(tmp_path / "b.splat", broken, corner.WORLD)
    assert not list(tmp_path.iterdir())
