"""The articulated asset, read and played by a reader of its own."""

import numpy as np
import pytest
from export_cases import corner, gltf_reader, moving
from scipy.spatial.transform import Rotation

from scas4d_core.errors import InputError
from scas4d_core.exports.gltf_parts import PartAsset
from scas4d_core.gaussians import moving_extent

pytest.importorskip("pygltflib", reason="the test reads with pygltflib")
FRAMES = 5


def written(path, states, times=None, labels=moving.LABELS):
    asset = PartAsset(path, corner.WORLD, labels)
    for frame, state in enumerate(states):
        asset.add(frame + 12, 100 + frame / moving.RATE if times is None else times[frame], state)
    asset.finish()
    return gltf_reader.Asset(path)


def test_the_animation_puts_every_gaussian_where_it_is(tmp_path):
    found = written(tmp_path / "a.glb", [moving.state(frame) for frame in range(FRAMES)])
    by_name = {node.name: node for node in found.nodes()}
    assert set(by_name) == {"part 0", "part 1", "static"}
    for frame in range(FRAMES):
        truth = corner.wanted(moving.state(frame), corner.Y_UP, metres=True)
        for name, label in (("part 0", 0), ("part 1", 1), ("static", -1)):
            got = found.animated(by_name[name], frame / moving.RATE)
            measured = corner.errors(got, truth.rows(label == moving.LABELS))
            assert measured["means"] < 3e-6
            assert measured["covariances"] < 1e-5
            assert measured["colours"] < 1e-6
            assert measured["opacities"] < 1e-7
    whole = [found.animated(by_name[name], 0.0) for name in ("part 0", "part 1", "static")]
    columns = zip(*(vars(one).values() for one in whole), strict=True)
    together = corner.Found(*(np.concatenate(arrays) for arrays in columns))
    truth = corner.wanted(moving.state(0), corner.Y_UP, metres=True)
    corner.assert_same(together, truth, means=3e-6, covariances=1e-5, colours=1e-6, opacities=1e-7)
    corner.assert_y_up(together.means)


def test_nodes_rest_in_the_first_frame(tmp_path):
    found = written(tmp_path / "a.glb", [moving.state(frame) for frame in range(2)])
    for node in found.nodes()[:2]:
        assert np.allclose(node.rotation, [0, 0, 0, 1], atol=1e-7)
        rows = node.extras["part"] == moving.LABELS
        own = found.splats(node).means
        truth = corner.wanted(moving.state(0), corner.Y_UP, metres=True).means[rows]
        np.testing.assert_allclose(own + node.translation, truth, atol=1e-6)
        assert (own.min(axis=0) <= 1e-6).all()  # the origin is amid the part
        assert (own.max(axis=0) >= -1e-6).all()


def test_times_are_seconds_since_the_first_frame(tmp_path):
    found = written(tmp_path / "a.glb", [moving.state(frame) for frame in range(3)])
    (animation,) = found.document.animations
    (place,) = {sampler.input for sampler in animation.samplers}
    np.testing.assert_allclose(found.accessor(place), [0, 0.04, 0.08], atol=1e-7)
    about = found.document.accessors[place]
    assert about.min == [0]
    assert about.max == [found.accessor(place)[-1]]
    assert found.document.asset.extras["first_time_s"] == 100


def test_quaternions_go_the_short_way(tmp_path):
    found = written(tmp_path / "a.glb", [moving.state(frame) for frame in range(9)])  # beyond a whole turn
    for channel in found.document.animations[0].channels:
        if channel.target.path == "rotation":
            values = found.accessor(found.document.animations[0].samplers[channel.sampler].output)
            assert ((values[1:] * values[:-1]).sum(axis=1) > 0).all()


def test_the_residual_is_told(tmp_path):
    bent = moving.state(1)
    means = bent.means.copy()
    rows = np.flatnonzero(moving.LABELS == 0)
    means[rows] += np.float32([[0, 0, 0.01]]) * np.float32([1, -1, 0, -1, 1])[:, None]
    found = written(tmp_path / "a.glb", [moving.state(0), moving.state(0), bent.replace(means=means)])
    zero, one = (node.extras for node in found.nodes()[:2])
    assert 0.1 < zero["residual_worst"] < 1.5  # of 1 cm, in the user's cm; more where others are followed
    assert zero["worst_frame"] == 14
    np.testing.assert_allclose(zero["residual_rms"], zero["residual_worst"] / np.sqrt(2), rtol=1e-4)
    extent = moving_extent(moving.state(0)) / corner.WORLD.metres_per_unit
    np.testing.assert_allclose(zero["residual_rms_percent"], 100 * zero["residual_rms"] / extent)
    assert one["residual_rms"] < 1e-4
    assert one["frames"] == 3


def test_a_joint_is_fixed_in_the_nodes_of_both_parts(tmp_path):
    """The centre and the axis of a hinge are given in the parent's coordinates; the child's node turns about them."""
    axis, angles = np.array([0.6, 0.0, 0.8]), 0.4 * np.arange(FRAMES)
    first = moving.state(0)
    rows = moving.LABELS == 1
    hinge = np.array([0.2, -1.3, 2])  # between the nearest Gaussians of the two parts
    states = []
    for angle in angles:
        turn = Rotation.from_rotvec(angle * axis)
        means, rotations = first.means.copy(), first.rotations.copy()
        means[rows] = turn.apply(means[rows] - hinge) + hinge
        rotations[rows] = np.roll(turn.as_quat(), 1)
        states.append(first.replace(means=means, rotations=rotations, foreground=np.float32(moving.LABELS >= 0)))
    labels = np.where(moving.LABELS == 1, 1, 0)  # part 0 is at rest
    found = written(tmp_path / "a.glb", states, labels=labels)
    parent, child = found.nodes()
    assert "joint" not in parent.extras
    joint = child.extras["joint"]
    assert (joint["kind"], joint["parent"]) == ("revolute", "part 0")
    np.testing.assert_allclose(joint["values"], angles, atol=1e-4)
    centre, about = np.array(joint["centre"]) + parent.translation, np.array(joint["axis"])
    np.testing.assert_allclose(about, axis * [1, -1, -1], atol=1e-4)
    for frame, angle in enumerate(angles):
        translation, turn = found.pose(child, frame / moving.RATE)
        np.testing.assert_allclose(turn.as_rotvec(), angle * about, atol=1e-4)
        np.testing.assert_allclose(turn.apply(centre - child.translation) + translation, centre, atol=1e-5)


def test_a_part_that_is_away_for_a_while_has_times_of_its_own(tmp_path):
    states = [moving.state(frame) for frame in range(3)]
    states[1] = states[1].retire(np.flatnonzero(moving.LABELS == 1))
    found = written(tmp_path / "a.glb", states)
    assert [node.extras["frames"] for node in found.nodes()[:2]] == [3, 2]
    assert len({sampler.input for sampler in found.document.animations[0].samplers}) == 2


def test_what_is_retired_in_the_first_frame_is_left_out(tmp_path):
    found = written(tmp_path / "a.glb", [moving.state(0).retire([1, 8])])
    ids = [found.attribute(node, "_ID").tolist() for node in found.nodes()]
    assert ids == [[50, 52, 53, 54], [55, 56, 57], [59]]


def test_times_must_rise(tmp_path):
    with pytest.raises(InputError, match=r"time 1 s of frame 13 is not later than the previous frame, 1 s"):
        written(tmp_path / "a.glb", [moving.state(0), moving.state(1)], times=[1.0, 1.0])
    with pytest.raises(InputError, match="there are no frames to export"):
        PartAsset(tmp_path / "a.glb", corner.WORLD, moving.LABELS).finish()
    assert not list(tmp_path.iterdir())
