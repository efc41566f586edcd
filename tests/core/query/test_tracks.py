import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import Camera, WorldFrame
from scas4d_core.gaussians import Gaussians
from scas4d_core.query.tracks import (
    carriers,
    confidence_of,
    geometric_median,
    tracks_of_ids,
    tracks_of_pixels,
    tracks_of_points,
)
from scas4d_core.storage.history import History, HistoryError

WORLD = WorldFrame(np.array([5.0, -3.0, 2.0]), 0.01)  # the user measures in centimetres, far from the origin
FRAMES = [0, 1, 2, 3, 4, 5]


def pose(t: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation of the body at frame t, inside world."""
    turn = Rotation.from_rotvec(np.array([0.2, 0.5, -0.1]) * t).as_matrix()
    return turn, np.array([0.1, 0.02, -0.05]) * t


def rigid_history(n: int = 400, stray: np.ndarray | None = None, size: float = 1.0) -> tuple[History, np.ndarray]:
    """A body of flat Gaussians that turns and travels; rows in ``stray`` leave it after frame 0."""
    rng = np.random.default_rng(1)
    rest = rng.uniform(-0.5, 0.5, size=(n, 3))
    axes = Rotation.random(n, random_state=2).as_matrix() * np.array([0.05, 0.03, 0.004]) * size
    history = History()
    for t in FRAMES:
        turn, shift = pose(t)
        means = rest @ turn.T + shift
        if stray is not None:
            means[stray] += 0.4 * t
        quaternion = np.roll(Rotation.from_matrix(turn).as_quat(), 1)
        state = Gaussians(
            means=means.astype(np.float32),
            factors=(turn @ axes).astype(np.float32),
            rotations=np.tile(quaternion, (n, 1)).astype(np.float32),
            opacities=np.full(n, 0.9, np.float32),
            colours=np.zeros((n, 3), np.float32),
            foreground=np.ones(n, np.float32),
            ids=np.arange(n, dtype=np.int64) * 3,
        )
        history.append(t, t / 30, state)
    return history, rest


def truth(rest: np.ndarray) -> np.ndarray:
    return np.stack([WORLD.to_user(rest @ pose(t)[0].T + pose(t)[1]) for t in FRAMES])


@pytest.mark.parametrize("count", [1, 8])
def test_points_of_a_rigid_body_are_carried_exactly_from_any_frame(count):
    history, rest = rigid_history()
    points = rest[:50] + 0.02
    expected = truth(points)
    for index in (0, 3):
        tracks = tracks_of_points(history, WORLD, expected[index], index, FRAMES, count)
        np.testing.assert_allclose(tracks.positions, expected, atol=2e-4)  # centimetres: float32 states
        assert tracks.indices.tolist() == FRAMES
    np.testing.assert_array_equal(
        tracks.positions[3],
        tracks_of_points(history, WORLD, expected[3], 3, [3], count).positions[0],
    )


def test_a_stray_carrier_does_not_take_the_point_with_it():
    stray = np.arange(0, 400, 10)
    history, _ = rigid_history(stray=stray, size=4)  # they overlap, as those of a trained scene do
    points = np.random.default_rng(3).uniform(-0.5, 0.5, size=(300, 3))
    expected = truth(points)
    single = tracks_of_points(history, WORLD, expected[0], 0, FRAMES, 1)
    several = tracks_of_points(history, WORLD, expected[0], 0, FRAMES)
    lost = [np.mean(np.abs(t.positions[-1] - expected[-1]).max(axis=-1) > 10) for t in (single, several)]
    assert lost[0] > 0.08
    assert lost[1] < 0.5 * lost[0]
    # And the confidence says which points had carriers that disagree.
    calm, _ = rigid_history(size=4)
    before = tracks_of_points(calm, WORLD, expected[0], 0, FRAMES).confidence
    rows, weights, _ = carriers(history.gaussians(0), points, 32, 0.01)
    torn = (np.isin(rows, stray) * weights).sum(axis=1) > 0.1
    assert torn.sum() >= 5
    assert np.all(several.confidence[-1, torn] < 0.2 * before[-1, torn])
    np.testing.assert_allclose(several.confidence[0], before[0])  # in the frame asked for, all carriers agree
    assert np.all(np.diff(several.confidence[:, torn], axis=0) < 0)  # and ever less from then on


def test_confidence_falls_with_disagreement_frames_and_missing_coverage():
    well = confidence_of(np.ones(5), np.array([0, 0.002, 0.005, 0.01, 0.05]), 10)
    assert np.all(np.diff(well) < 0)
    assert well[0] > 0.9
    assert well[-1] < 0.1
    assert np.all(confidence_of(np.ones(5), np.full(5, 0.005), 1) > confidence_of(np.ones(5), np.full(5, 0.005), 20))
    partly = confidence_of(np.array([0.0, 0.15, 0.3, 1.0]), np.zeros(4), 1)
    assert partly[0] == 0
    assert partly[1] == pytest.approx(0.5 * partly[2])
    assert partly[2] == partly[3]


def test_confidence_is_high_where_carriers_agree_and_0_away_from_all():
    history, rest = rigid_history()
    points = np.vstack([truth(rest)[0][7], WORLD.to_user([[4.0, 4.0, 4.0]])])
    tracks = tracks_of_points(history, WORLD, points, 0, FRAMES)
    assert tracks.confidence.shape == (6, 2)
    assert np.all(tracks.confidence[:, 0] > 0.9)
    assert np.all(np.diff(tracks.confidence[:, 0]) < 0)  # errors add up from frame to frame
    assert np.all(tracks.confidence[:, 1] < 1e-6)
    assert tracks.ids[0] == 7 * 3


def test_carriers_go_by_shape_not_by_distance():
    # The point lies 0.3 along the long axis of row 0 and 0.1 off the flat side of row 1.
    state = (
        rigid_history(2)[0]
        .gaussians(0)
        .replace(
            means=np.array([[0, 0, 0], [0.3, 0.1, 0]], np.float32),
            factors=np.stack([np.diag([0.2, 0.01, 0.01]), np.diag([0.2, 0.01, 0.2])]).astype(np.float32),
        )
    )
    rows, weights, covered = carriers(state, np.array([[0.3, 0.0, 0.0]]), 5, 0.0)
    assert rows.tolist() == [[0, 1]]
    np.testing.assert_allclose(weights.sum(), 1)
    np.testing.assert_allclose(covered, 0.9 * np.exp(-0.5 * 1.5**2), rtol=1e-6)


def test_geometric_median_is_at_least_as_near_as_any_neighbour():
    rng = np.random.default_rng(0)
    points, weights = rng.normal(size=(20, 8, 3)), rng.dirichlet(np.ones(8), 20)

    def cost(centre):
        return (weights * np.linalg.norm(points - centre[:, None], axis=-1)).sum(axis=1)

    centre = geometric_median(points, weights)
    assert np.all(cost(centre) <= cost(np.einsum("qk,qki->qi", weights, points)) + 1e-12)
    for direction in rng.normal(size=(30, 3)):
        step = 0.1 * direction / np.linalg.norm(direction)
        assert np.all(cost(centre) <= cost(centre + step) + 1e-6)


CAMERA = Camera("front", np.array([[100.0, 0, 32], [0, 100, 24], [0, 0, 1]]), np.eye(4), 64, 48)


def sheet(z: float, half: float, opacity: float, id: int) -> Gaussians:
    """One flat Gaussian that faces the camera, inside world."""
    return Gaussians(
        means=np.array([[0, 0, z]], np.float32),
        factors=np.diag([half, half, 1e-3])[None].astype(np.float32),
        rotations=np.array([[1, 0, 0, 0]], np.float32),
        opacities=np.array([opacity], np.float32),
        colours=np.zeros((1, 3), np.float32),
        foreground=np.ones(1, np.float32),
        ids=np.array([id], np.int64),
    )


def stacked(*parts: Gaussians) -> Gaussians:
    return Gaussians(**{name: np.concatenate([p.arrays()[name] for p in parts]) for name in parts[0].arrays()})


def test_pixels_go_along_their_rays_and_report_what_met_no_surface(monkeypatch):
    history = History()
    for t in FRAMES:  # a small sheet 2 m away that sinks, in centimetres 200
        state = sheet(2.0, 0.05, 0.9, 7)
        history.append(t, t / 30, state.replace(means=state.means + np.array([0, 0.01 * t, 0], np.float32)))
    user_camera = Camera(
        "c",
        CAMERA.intrinsics,
        np.block([[np.eye(3), -WORLD.origin[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]),
        64,
        48,
    )
    asked: list[int] = []

    def depth(_: Camera, index: int) -> tuple[np.ndarray, np.ndarray]:
        asked.append(index)
        alpha = np.zeros((48, 64))
        alpha[20:28, 28:36] = 1
        return np.full((48, 64), 190.0), alpha

    uv = np.array([[32.3, 24.9], [5.5, 24.5], [37.5, 24.5]])  # the last misses the covered pixels by two
    tracks = tracks_of_pixels(history, WORLD, user_camera, uv, 0, FRAMES, depth)
    assert asked == [0]  # once, for what the rays missed
    assert tracks.ids.tolist() == [7, -1, 7]
    assert np.all(tracks.confidence[:, 1] == 0)
    assert np.isnan(tracks.positions[:, 1]).all()
    np.testing.assert_allclose(tracks.pixels(user_camera)[0, [0, 2]], uv[[0, 2]], atol=1e-3)
    near = user_camera.project(tracks.positions[0, [0, 2]])[1]
    np.testing.assert_allclose(near, [200, 190], atol=0.2)  # by its ray; by the covered pixel beside it
    np.testing.assert_allclose(np.diff(tracks.positions[:, 0], axis=0), [[0, 1, 0]] * 5, atol=1e-3)
    assert tracks.visibility["c"].shape == (6, 3)
    assert tracks.visibility["c"][0, 1] == np.False_
    monkeypatch.setattr("scas4d_core.query.tracks.PIXEL_REACH", 1)
    assert tracks_of_pixels(history, WORLD, user_camera, uv, 0, FRAMES, depth).ids[2] == -1
    with pytest.raises(ValueError, match=r"pixel \[64\.0, 3\.0\] \(query 1\) is outside"):
        tracks_of_pixels(history, WORLD, user_camera, np.array([[1, 1], [64, 3]]), 0, FRAMES, depth)


def test_tracks_of_ids_are_the_means():
    history, rest = rigid_history()
    tracks = tracks_of_ids(history, WORLD, np.array([30, 0]), [4, 2])
    np.testing.assert_allclose(tracks.positions, truth(rest[[10, 0]])[[4, 2]], atol=1e-4)
    with pytest.raises(ValueError, match=r"unknown Gaussian ids \[31\]"):
        tracks_of_ids(history, WORLD, np.array([31]), [0])


def test_refusals():
    history, _ = rigid_history(10)
    with pytest.raises(ValueError, match=r"points \[1\] contain NaN"):
        tracks_of_points(history, WORLD, np.array([[0, 0, 0], [np.nan, 0, 0]]), 0, FRAMES)
    with pytest.raises(ValueError, match=r"expected \[Q, 3\]"):
        tracks_of_points(history, WORLD, np.zeros(3), 0, FRAMES)
    with pytest.raises(HistoryError, match="frame 9"):
        tracks_of_points(history, WORLD, np.zeros((1, 3)), 0, [9])


def living_history() -> tuple[History, np.ndarray]:
    """The body, half of which is born in frame 2; the other half is retired in frames 3 and 4."""
    whole, rest = rigid_history()
    history, rows = History(), np.arange(200, 400)
    for t in FRAMES:
        state = whole.gaussians(t)
        if t < 2:
            state = state.rows(np.arange(200))
        else:
            ids = np.where(np.arange(400) < 200, state.ids, -1)
            state = state.replace(ids=ids if t == 2 else np.concatenate([state.ids[:200], history.ids[200:]]))
        if t in (3, 4):
            state = state.retire(np.arange(200))
        history.append(t, t / 30, state, parents=np.zeros(200, np.int64) if t == 2 else None)
    assert history.born_at[rows].tolist() == [2] * 200
    return history, rest


def test_tracks_where_gaussians_are_absent():
    history, rest = living_history()
    early, late = history.ids[0], history.ids[250]
    tracks = tracks_of_ids(history, WORLD, np.array([early, late]), FRAMES)
    there = np.array([[True, False], [True, False], [True, True], [False, True], [False, True], [True, True]])
    np.testing.assert_array_equal(np.isfinite(tracks.positions).all(axis=-1), there)
    np.testing.assert_array_equal(tracks.confidence, there)
    np.testing.assert_allclose(tracks.positions[there], truth(rest[[0, 250]])[there], atol=1e-4)

    # Of a point, those of its carriers tell that are there; without any it is nowhere, and seen by nobody.
    tracks = tracks_of_points(history, WORLD, truth(rest[:1])[0], 0, FRAMES)
    np.testing.assert_array_equal(np.isfinite(tracks.positions[:, 0, 0]), there[:, 0])
    assert (tracks.confidence[:, 0] > 0).tolist() == there[:, 0].tolist()
    visible = tracks.with_visibility(history, WORLD, CAMERA, 0).visibility[CAMERA.name]
    assert not visible[3:5].any()

    # Retired Gaussians carry nothing, wherever they were: the born take the point.
    tracks = tracks_of_points(history, WORLD, truth(rest[:1])[3], 3, FRAMES)
    assert tracks.ids[0] >= history.ids[200]
    np.testing.assert_array_equal(np.isfinite(tracks.positions[:, 0, 0]), [False, False, True, True, True, True])
