import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import WorldFrame
from scas4d_core.gaussians import Gaussians
from scas4d_core.query.ply import PlyError, read_ply, split_factors, write_ply

WORLD = WorldFrame(np.array([10.0, -20.0, 5.0]), 0.01)


def state(factors: np.ndarray) -> Gaussians:
    n = len(factors)
    rng = np.random.default_rng(0)
    return Gaussians(
        means=rng.normal(size=(n, 3)).astype(np.float32),
        factors=factors.astype(np.float32),
        rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        opacities=rng.uniform(0.02, 0.98, n).astype(np.float32),
        colours=rng.random((n, 3)).astype(np.float32),
        foreground=np.ones(n, np.float32),
        ids=np.arange(n, dtype=np.int64) + 50,
    )


def random_factors(n: int, seed: int = 0) -> np.ndarray:
    """Axes that a deformation has sheared."""
    rng = np.random.default_rng(seed)
    straight = Rotation.random(n, random_state=seed).as_matrix() * rng.uniform(0.002, 0.05, (n, 1, 3))
    return (np.eye(3) + 0.5 * rng.normal(size=(n, 3, 3))) @ straight


def test_round_trip_in_the_users_units(tmp_path):
    theta = state(random_factors(200))
    write_ply(tmp_path / "frame.ply", theta, WORLD)
    back = read_ply(tmp_path / "frame.ply")
    assert len(back) == 200
    np.testing.assert_allclose(back.means, WORLD.to_user(theta.means), rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(back.opacities, theta.opacities, rtol=1e-5)
    np.testing.assert_allclose(back.colours, theta.colours, atol=1e-6)
    factors = theta.factors.astype(np.float64) / 0.01
    covariances = factors @ factors.transpose(0, 2, 1)
    size = np.abs(covariances).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(back.covariances() / size, covariances / size, atol=2e-6)


def test_the_file_is_the_standard_one(tmp_path):
    write_ply(tmp_path / "frame.ply", state(random_factors(3)), WORLD)
    content = (tmp_path / "frame.ply").read_bytes()
    header = content[: content.index(b"end_header\n")].decode().splitlines()
    assert header[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "element vertex 3" in header
    names = [line.split()[2] for line in header if line.startswith("property")]
    assert names == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity",
                     "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]  # fmt: skip
    assert all(line.split()[1] == "float" for line in header if line.startswith("property"))
    assert [f.name for f in tmp_path.iterdir()] == ["frame.ply"]


def test_undeformed_gaussians_keep_their_axes_even_where_lengths_are_equal():
    turns = Rotation.random(60, random_state=4)
    lengths = np.array([[0.03, 0.03, 0.03], [0.02, 0.02, 0.01], [0.01, 0.03, 0.02]])[np.arange(60) % 3]
    axes, scales = split_factors((turns.as_matrix() * lengths[:, None]).astype(np.float32))
    np.testing.assert_allclose(axes, turns.as_matrix(), atol=1e-6)
    np.testing.assert_allclose(scales, lengths, rtol=1e-6)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6))
def test_split_keeps_the_covariance_and_is_the_nearest(seed):
    factors = random_factors(4, seed) * np.array([1, 1, (-1) ** seed])  # a left-handed factor too
    axes, scales = split_factors(factors)
    covariance = factors @ factors.transpose(0, 2, 1)
    np.testing.assert_allclose(
        axes * scales[:, None] ** 2 @ axes.transpose(0, 2, 1), covariance, atol=2e-6 * abs(covariance).max()
    )
    np.testing.assert_allclose(np.linalg.det(axes), 1, atol=1e-9)
    wanted = factors / np.linalg.norm(factors, axis=1)[:, None]
    group = Rotation.create_group("O").as_matrix()  # every renaming of the axes of a right-handed frame
    traces = np.einsum("nki,gij,nkj->ng", axes, group, wanted)
    assert np.all(np.einsum("nki,nki->n", axes, wanted) >= traces.max(axis=1) - 1e-9)


def test_saturated_opacity_stays_finite(tmp_path):
    theta = state(random_factors(2)).replace(opacities=np.array([1.0, 0.0], np.float32))
    write_ply(tmp_path / "f.ply", theta, WORLD)
    assert np.isfinite(PlyData.read(str(tmp_path / "f.ply"))["vertex"]["opacity"]).all()
    np.testing.assert_allclose(read_ply(tmp_path / "f.ply").opacities, [1, 0], atol=2e-6)


def test_bad_rows_are_named_and_nothing_is_written(tmp_path):
    theta = state(random_factors(6))
    means = theta.means.copy()
    means[[2, 4], 1] = np.nan
    with pytest.raises(PlyError, match=r"2 Gaussians have non-finite means: rows \[2, 4\], ids \[52, 54\]"):
        write_ply(tmp_path / "f.ply", theta.replace(means=means), WORLD)
    factors = theta.factors.copy()
    factors[3, :, 0] = 0
    with pytest.raises(PlyError, match=r"no volume .*rows \[3\], ids \[53\]"):
        write_ply(tmp_path / "f.ply", theta.replace(factors=factors), WORLD)
    assert not list(tmp_path.iterdir())
    (tmp_path / "not.ply").write_bytes(b"hello")
    with pytest.raises(PlyError, match=r"not\.ply"):
        read_ply(tmp_path / "not.ply")


@pytest.mark.parametrize(
    ("column", "value"), [("x", np.nan), ("scale_1", 1e5), ("opacity", np.nan), ("f_dc_2", np.inf), ("rot", 0)]
)
def test_files_with_unusable_rows_are_refused(tmp_path, column, value):
    write_ply(tmp_path / "frame.ply", state(random_factors(6)), WORLD)
    file = PlyData.read(str(tmp_path / "frame.ply"))
    for name in ("rot_0", "rot_1", "rot_2", "rot_3") if column == "rot" else (column,):
        file["vertex"][name][[1, 4]] = value
    file.write(str(tmp_path / "bad.ply"))
    with pytest.raises(PlyError, match=r"bad\.ply has 2 Gaussians with non-finite .* rows \[1, 4\]"):
        read_ply(tmp_path / "bad.ply")


def test_retired_ones_are_left_out(tmp_path):
    theta = state(random_factors(6))
    write_ply(tmp_path / "frame.ply", theta.retire([1, 4]), WORLD)
    write_ply(tmp_path / "others.ply", theta.rows([0, 2, 3, 5]), WORLD)
    assert (tmp_path / "frame.ply").read_bytes() == (tmp_path / "others.ply").read_bytes()


def test_a_frame_of_which_all_are_retired_is_an_empty_file(tmp_path):
    write_ply(tmp_path / "frame.ply", state(random_factors(2)).retire([0, 1]), WORLD)
    assert len(read_ply(tmp_path / "frame.ply")) == 0
