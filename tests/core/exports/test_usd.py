"""USD, read by pxr: arrays, transforms as UsdGeom composes them, cameras as Gf projects, and USD's own validators."""

import numpy as np
import pytest
from export_cases import corner, moving

from scas4d_core.errors import InputError
from scas4d_core.exports.usd import UsdSequence
from scas4d_core.gaussians import Gaussians

pytest.importorskip("pxr", reason="USD needs usd-core: pip install 'scas4d[exports]'")
from pxr import Gf, Usd, UsdGeom, UsdVol

LIMITS = {"means": 2e-5, "covariances": 3e-6, "colours": 1e-6, "opacities": 1e-7}
BORN = 2
"""Frame of a birth."""
GONE = (1, 2)
"""Frames in which row 3 is retired."""


def states(gloss=False):
    """Four frames: row 3 goes and comes back, row 10 is born in frame 2."""
    for frame in range(4):
        state = moving.state(frame, gloss)
        if frame in GONE:
            state = state.retire([3])
        if frame >= BORN:
            born = Gaussians.of_points([[0.4, -1.0, 2.5 + 0.1 * frame]], 0.02, [0.9, 0.2, 0.1])
            state = state.concatenate(born)
            state = state.replace(ids=np.append(state.ids[:-1], 77))
        yield state


def written(path, given=None, **about):
    sequence = UsdSequence(path, corner.WORLD, **about)
    for frame, state in enumerate(states() if given is None else given):
        sequence.add(frame + 12, 100 + frame / moving.RATE, state)
    sequence.finish()
    assert [each.name for each in path.parent.iterdir()] == [path.name]
    return Usd.Stage.Open(str(path))


def splat(stage):
    return UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/World/Gaussians"))


def found(stage, code) -> corner.Found:
    """The Gaussians at a time code; each rotation by Gf, not by the memory of its quaternion."""
    prim = splat(stage)
    scales = np.array(prim.GetScalesAttr().Get(code), np.float64)
    axes = np.array([Gf.Matrix3d(Gf.Rotation(Gf.Quatd(q))) for q in prim.GetOrientationsAttr().Get(code)])
    factors = axes.transpose(0, 2, 1) * scales[:, None, :]  # rows of USD's matrices are columns here
    degree = prim.GetRadianceSphericalHarmonicsDegreeAttr().Get()
    harmonics = np.array(prim.GetRadianceSphericalHarmonicsCoefficientsAttr().Get(code), np.float64)
    return corner.Found(
        np.array(prim.GetPositionsAttr().Get(code), np.float64),
        factors @ factors.transpose(0, 2, 1),
        0.5 + 0.28209479177387814 * harmonics.reshape(-1, (degree + 1) ** 2, 3)[:, 0],
        np.array(prim.GetOpacitiesAttr().Get(code), np.float64),
    )


@pytest.mark.parametrize("suffix", [".usdc", ".usda", ".usdz", ".usd"])
def test_a_fixed_set_of_gaussians_over_all_frames(tmp_path, suffix):
    stage = written(tmp_path / f"a{suffix}")
    for frame, state in enumerate(states()):
        got = found(stage, frame)
        assert len(got.means) == 11
        here = len(state)
        corner.assert_same(got.rows(np.arange(10)), corner.wanted(state.rows(np.arange(10)), corner.Y_UP), **LIMITS)
        assert (got.opacities[3] == 0) == (frame in GONE)
        assert (got.opacities[10] == 0) == (frame < BORN)
        if here == 11:
            measured = corner.errors(got, corner.wanted(state, corner.Y_UP))
            assert all(measured[name] < limit for name, limit in LIMITS.items())
    corner.assert_y_up(found(stage, 0).means[:10])
    np.testing.assert_allclose(found(stage, 0).means[10], found(stage, BORN).means[10])  # waits where it is born
    np.testing.assert_allclose(found(stage, 1).colours[10], [0.9, 0.2, 0.1], atol=1e-6)


def test_stage_metadata(tmp_path):
    stage = written(tmp_path / "a.usdc")
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 0.01
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == 25
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, 3)
    assert stage.GetDefaultPrim().GetPath() == "/World"
    assert dict(stage.GetRootLayer().customLayerData["scas4d"]) == {"first_frame": 12, "first_time_s": 100}
    primvars = UsdGeom.PrimvarsAPI(splat(stage))
    assert list(primvars.GetPrimvar("scas4d:id").Get()) == [*range(50, 60), 77]
    assert not primvars.GetPrimvar("scas4d:part")


def test_values_that_stay_are_told_once(tmp_path):
    stage = written(tmp_path / "a.usdc")
    prim = splat(stage)
    harmonics = prim.GetRadianceSphericalHarmonicsCoefficientsAttr()
    assert harmonics.GetNumTimeSamples() == 0  # a default, the birth included
    assert len(harmonics.Get()) == 11
    assert harmonics.GetColorSpace() == "srgb_rec709_scene"
    assert prim.GetPositionsAttr().GetTimeSamples() == [0, 1, 2, 3]


def test_between_samples_nothing_fades_early(tmp_path):
    """A value that holds for long and then changes is told again just before."""
    given = [moving.state(0)] * 3 + [moving.state(0).retire([3])]
    stage = written(tmp_path / "a.usdc", given)
    prim = splat(stage)
    assert prim.GetOpacitiesAttr().GetTimeSamples() == [0, 2, 3]
    assert prim.GetOpacitiesAttr().Get(1.5)[3] == moving.state(0).opacities[3]
    assert prim.GetOpacitiesAttr().Get(3)[3] == 0


def test_gloss_is_turned_with_the_axes(tmp_path):
    stage = written(tmp_path / "a.usdc", [corner.state(gloss=True)])
    attribute = splat(stage).GetRadianceSphericalHarmonicsCoefficientsAttr()
    assert UsdGeom.Primvar(attribute).GetElementSize() == 16
    harmonics = np.array(attribute.Get(), np.float64).reshape(10, 16, 3)
    truth = corner.seen_truly(corner.state(gloss=True))
    np.testing.assert_allclose(corner.seen(harmonics, corner.Y_UP), truth, atol=1e-5)
    assert np.abs(corner.seen(harmonics, np.ones(3)) - truth).max() > 0.1


def test_parts_move_as_xforms(tmp_path):
    stage = written(tmp_path / "a.usdc", labels=moving.LABELS)
    parts = UsdGeom.PrimvarsAPI(splat(stage)).GetPrimvar("scas4d:part")
    assert list(parts.Get()) == [*moving.LABELS, -1]
    for part in (0, 1):
        xform = stage.GetPrimAtPath(f"/World/Parts/part_{part}")
        rows = np.flatnonzero((part == moving.LABELS) & (np.arange(10) != 3))
        rest = UsdGeom.XformCache(0).GetLocalToWorldTransform(xform).GetInverse()
        start = found(stage, 0).means[rows]
        for frame in range(4):
            now = UsdGeom.XformCache(frame).GetLocalToWorldTransform(xform)
            carried = [now.Transform(rest.Transform(Gf.Vec3d(*point.tolist()))) for point in start]
            np.testing.assert_allclose(carried, found(stage, frame).means[rows], atol=2e-4)
            assert xform.GetAttribute("scas4d:residual").Get(frame) < 1e-4


def test_tracks_are_centres_of_what_moves(tmp_path):
    stage = written(tmp_path / "a.usdc")
    tracks = UsdGeom.Points(stage.GetPrimAtPath("/World/Tracks"))
    rows = np.flatnonzero(moving.LABELS >= 0)
    assert list(tracks.GetIdsAttr().Get()) == (rows + 50).tolist()
    for frame, state in enumerate(states()):
        truth = corner.wanted(state, corner.Y_UP).means[rows]
        np.testing.assert_allclose(np.array(tracks.GetPointsAttr().Get(frame)), truth, atol=2e-5)
        assert (np.array(tracks.GetWidthsAttr().Get(frame)) > 0).tolist() == state.present[rows].tolist()
    assert tracks.GetPurposeAttr().Get() == "guide"


def test_cameras_see_what_the_rig_sees(tmp_path):
    rig = corner.rig()
    stage = written(tmp_path / "a.usdc", rig=rig)
    prims = stage.GetPrimAtPath("/World/Cameras").GetChildren()
    assert [prim.GetDisplayName() for prim in prims] == ["a-1", "a.1"]
    points = corner.wanted(corner.state(), corner.Y_UP).means
    for prim, camera in zip(prims, rig.cameras, strict=True):
        frustum = UsdGeom.Camera(prim).GetCamera(0).frustum
        seen = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
        places = np.array([seen.Transform(Gf.Vec3d(*point.tolist())) for point in points])
        pixels = np.stack([(places[:, 0] + 1) / 2 * camera.width, (1 - places[:, 1]) / 2 * camera.height], axis=1)
        truth, depth = camera.project(corner.wanted(corner.state()).means)
        assert (depth > 0).all()
        np.testing.assert_allclose(pixels, truth, atol=0.01)


def test_usd_finds_no_fault(tmp_path):
    validation = pytest.importorskip("pxr.UsdValidation", reason="this usd-core has no UsdValidation")
    stage = written(tmp_path / "a.usdz", rig=corner.rig(), labels=moving.LABELS)
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10
    faults = validation.ValidationContext(validators).Validate(stage)
    assert [fault.GetErrorAsString() for fault in faults] == []


def test_without_a_rate_the_first_two_frames_tell_it(tmp_path):
    sequence = UsdSequence(tmp_path / "a.usda", corner.WORLD)
    for frame, time in enumerate((5.0, 5.1, 5.25)):
        sequence.add(frame, time, moving.state(frame))
    sequence.finish()
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    assert stage.GetTimeCodesPerSecond() == pytest.approx(10)
    assert splat(stage).GetPositionsAttr().GetTimeSamples() == pytest.approx([0, 1, 2.5])


def test_given_up_and_refused_nothing_is_left(tmp_path):
    sequence = UsdSequence(tmp_path / "a.usdc", corner.WORLD)
    sequence.add(0, 0.0, corner.state())
    with pytest.raises(InputError, match=r"time 0 s of frame 1 is not later than the previous frame, 0 s"):
        sequence.add(1, 0.0, corner.state())
    sequence.discard()
    with pytest.raises(InputError, match="there are no frames to export"):
        UsdSequence(tmp_path / "a.usdc", corner.WORLD).finish()
    with pytest.raises(InputError, match=r"out 'a\.fbx' has no USD suffix; use one of \.usdc"):
        UsdSequence(tmp_path / "a.fbx", corner.WORLD)
    with pytest.raises(InputError, match=r"out '.*a\.usdc' cannot be written"):
        UsdSequence(tmp_path / "no" / "a.usdc", corner.WORLD)
    assert not list(tmp_path.iterdir())
