"""A scene that is taken up again: after every frame, in every kind of scene, from every kind of damage."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from box_scene import SHIFT, make_box, make_rig, moved, take_frame
from PIL import Image
from scipy.spatial.transform import Rotation

from scas4d_core.captures.frame import Frame, InitialPoints
from scas4d_core.captures.images import decode_image
from scas4d_core.checkpoint import CheckpointError, Checkpoints
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.reconstruction import Reconstruction, ResumeError
from scas4d_core.settings import SceneSettings, Settings, StaticSettings, UpdateSettings
from scas4d_core.storage.history import History
from scas4d_core.update.view_factory import ViewFactory
from scas4d_core.update.warm_start import Motion

BOX = make_box()
RIG = make_rig()
TURN = Rotation.from_rotvec([0, 0.06, 0])
FRAMES = [take_frame(3 + k, 0.1 * k, moved(BOX, TURN**k, k * SHIFT), RIG) for k in range(5)]
INDICES = [frame.index for frame in FRAMES]
POINTS = InitialPoints(BOX.means.astype(np.float64), BOX.colours, BOX.foreground)
EXPOSURES = {f"c{k}": np.float32([[1.01, 0.013 * k]] * 3) for k in range(6)}
UPDATE = UpdateSettings(iterations=4, clusters=(2, 12), momentum=0.5)


def settings(**scene: object) -> Settings:
    return Settings(
        scene=SceneSettings(metres_per_unit=1.0, **scene),  # type: ignore[arg-type]
        static=StaticSettings(iterations=12, max_gaussians=400, exposure=True),
        update=UPDATE,
    )


def as_jpeg(frame: Frame) -> Frame:
    """The frame without masks, as it is after its images were sent as JPEG files."""
    files = {}
    for name, image in frame.images.items():
        file = io.BytesIO()
        Image.fromarray(image).save(file, "JPEG", quality=95)
        files[name] = memoryview(file.getvalue())
    return Frame(frame.index, frame.time, {name: decode_image(files[name]) for name in files}, {}, files)


KINDS: dict[str, tuple[Settings, Callable[[Frame], Frame], StaticResult | None]] = {
    "masks, floor, image scale and exposures": (
        settings(image_scale=0.5, floor=(0.0, 1.0, 0.0, -0.3)),
        lambda frame: frame,
        None,
    ),
    "without masks": (
        settings(),
        lambda frame: replace(frame, masks={}),
        StaticResult(BOX.replace(foreground=np.ones(len(BOX), np.float32)), EXPOSURES, [0.5], [20.0]),
    ),
    "image files without masks": (
        settings(),
        as_jpeg,
        StaticResult(BOX.replace(foreground=np.ones(len(BOX), np.float32)), EXPOSURES, [0.5], [20.0]),
    ),
    "without masks, cameras missing": (
        settings(image_scale=0.5),
        lambda frame: replace(
            frame, masks={}, images={n: i for n, i in frame.images.items() if n != f"c{frame.index % 6}"}
        ),
        StaticResult(BOX.replace(foreground=np.ones(len(BOX), np.float32)), {}, [0.5]),
    ),
}


def begin(kind: str, folder: Path) -> Reconstruction:
    given, change, static = KINDS[kind]
    history = History.open(folder)
    return Reconstruction.start(RIG, change(FRAMES[0]), given, points=POINTS, history=history, static=static)


def go_on(kind: str, scene: Reconstruction) -> Reconstruction:
    for frame in FRAMES:
        if frame.index > scene.history.indices[-1]:
            scene.step(KINDS[kind][1](frame))
    return scene


def resume(kind: str, folder: Path, **given: Callable[[int], bool]) -> Reconstruction:
    return Reconstruction.resume(RIG, KINDS[kind][0], History.open(folder), **given)


def same_motion(a: Motion | None, b: Motion | None) -> bool:
    def arrays(motion: Motion | None) -> list[object]:
        return [] if motion is None else [getattr(motion, item.name) for item in fields(motion)]

    return all(
        np.array_equal(np.concatenate(x) if isinstance(x, list) else x, np.concatenate(y) if isinstance(y, list) else y)
        for x, y in zip(arrays(a), arrays(b), strict=True)
    )


def assert_same(one: Reconstruction, other: Reconstruction, indices: list[int] = INDICES) -> None:
    assert one.history.indices == indices
    assert other.history.indices == indices
    for index in indices:
        for name, array in one.history.gaussians(index).arrays().items():
            np.testing.assert_array_equal(
                array, getattr(other.history.gaussians(index), name), err_msg=f"{index} {name}"
            )
    assert same_motion(one._prepared.carried.motion, other._prepared.carried.motion)
    assert one._prepared.carried.motion is not None
    assert np.array_equal(one._prepared.carried.labels, other._prepared.carried.labels)  # type: ignore[arg-type]
    assert one._prepared.carried.structure == other._prepared.carried.structure
    assert [view.name for view in one._prepared.carried.seen] == [view.name for view in other._prepared.carried.seen]
    for a, b in zip(one._prepared.carried.seen, other._prepared.carried.seen, strict=True):
        np.testing.assert_array_equal(a.target[:3], b.target[:3])


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[Reconstruction, Path]]:
    """The whole scene, and a folder with a copy of its folder after every commit."""
    found: dict[str, tuple[Reconstruction, Path]] = {}

    def of(kind: str) -> tuple[Reconstruction, Path]:
        if kind not in found:
            base = tmp_path_factory.mktemp("scene")
            scene = begin(kind, base / "live")
            for frame in FRAMES:
                if frame.index > INDICES[0]:
                    scene.step(KINDS[kind][1](frame))
                shutil.copytree(base / "live", base / f"after {frame.index}")
            found[kind] = scene, base
        return found[kind]

    return of


def copy_of(base: Path, index: int, to: Path) -> Path:
    return shutil.copytree(base / f"after {index}", to / "states")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("index", INDICES)
def test_resumed_after_any_frame_it_goes_on_with_the_same_bits(kind, index, undisturbed, tmp_path):
    whole, base = undisturbed(kind)
    scene = resume(kind, copy_of(base, index, tmp_path))
    assert scene.resumed is not None
    assert (scene.resumed.index, scene.resumed.undone, scene.resumed.faults, scene.resumed.cold) == (
        index, [], [], False,
    )  # fmt: skip
    assert_same(whole, go_on(kind, scene))
    assert len(list((tmp_path / "states").glob("checkpoint_*"))) == 2


def test_the_scenes_are_what_they_should_be(undisturbed):
    """Otherwise the test above says little: labels are learnt late, exposures differ from 1."""
    scene, _ = undisturbed("without masks")
    learn_labels = [scene.history.report(index).get("learn_labels") for index in INDICES]
    assert learn_labels[0] is None
    assert any(learn_labels[1:])
    assert 0 < scene._prepared.carried.labels.sum() < len(BOX)
    scene, _ = undisturbed("masks, floor, image scale and exposures")
    assert any((exposure != [1, 0]).any() for exposure in scene._fixed.exposures.values())


def test_resumed_after_every_single_frame(undisturbed, tmp_path):
    """As many processes as frames."""
    kind = "without masks"
    whole, base = undisturbed(kind)
    folder = copy_of(base, INDICES[0], tmp_path)
    for frame in FRAMES[1:]:
        scene = resume(kind, folder)
        scene.step(KINDS[kind][1](frame))
    assert_same(whole, scene)


@pytest.mark.parametrize("kind", list(KINDS)[:2])
@pytest.mark.parametrize("what", ["frame", "checkpoint"])
def test_a_damaged_newest_file_costs_one_frame_and_no_bit(kind, what, undisturbed, tmp_path):
    whole, base = undisturbed(kind)
    for name, spoil in SPOILS.items():
        folder = copy_of(base, INDICES[3], tmp_path / name)
        file = folder / f"{what}_{INDICES[3]:06d}.npz"
        spoil(file)
        scene = resume(kind, folder)
        assert scene.resumed.undone == [INDICES[3]], name
        assert not scene.resumed.cold
        assert file.name in scene.resumed.faults[0]
        assert scene.history.indices == INDICES[:3]
        assert_same(whole, go_on(kind, scene))
        assert scene.history.report(INDICES[3])["resumed"]["undone"] == [INDICES[3]]
        assert scene.history.report(INDICES[4])["resumed"] is None


SPOILS: dict[str, Callable[[Path], object]] = {
    "emptied": lambda file: file.write_bytes(b""),
    "cut": lambda file: file.write_bytes(file.read_bytes()[: file.stat().st_size // 2]),
    "noise": lambda file: file.write_bytes(np.random.default_rng(0).bytes(5000)),
}


def test_a_whole_state_that_cannot_be_made_again_is_gone_on_from(undisturbed, tmp_path):
    """Its checkpoint is damaged and its pictures are gone: the next update starts cold, and the state is kept."""
    for kind in ("masks, floor, image scale and exposures", "without masks"):
        whole, base = undisturbed(kind)
        folder = copy_of(base, INDICES[3], tmp_path / kind)
        SPOILS["cut"](folder / f"checkpoint_{INDICES[3]:06d}.npz")
        scene = resume(kind, folder, held=lambda index: False)
        assert (scene.resumed.index, scene.resumed.undone, scene.resumed.cold) == (INDICES[3], [], True)
        assert (scene._prepared.carried.labels is None) == (whole._prepared.carried.labels is None)
        go_on(kind, scene)
        assert scene.history.indices == INDICES
        report = scene.history.report(INDICES[4])
        assert report["cold"]
        assert report["resumed"]["cold"]


def test_without_any_checkpoint_the_newest_whole_state_is_gone_on_from(undisturbed, tmp_path):
    kind = "masks, floor, image scale and exposures"
    _, base = undisturbed(kind)
    folder = copy_of(base, INDICES[3], tmp_path)
    for file in folder.glob("checkpoint_*"):
        file.unlink()
    SPOILS["cut"](folder / f"frame_{INDICES[3]:06d}.npz")
    scene = resume(kind, folder)
    assert (scene.resumed.index, scene.resumed.undone, scene.resumed.cold) == (INDICES[2], [INDICES[3]], True)
    assert go_on(kind, scene).history.indices == INDICES


def test_a_lost_frame_between_is_left_out_and_harms_nothing(undisturbed, tmp_path):
    kind = "masks, floor, image scale and exposures"
    whole, base = undisturbed(kind)
    folder = copy_of(base, INDICES[3], tmp_path)
    SPOILS["cut"](folder / f"frame_{INDICES[1]:06d}.npz")
    scene = resume(kind, folder)
    assert (scene.resumed.index, scene.resumed.undone, scene.resumed.cold) == (INDICES[3], [], False)
    go_on(kind, scene)
    assert scene.history.indices == [index for index in INDICES if index != INDICES[1]]
    assert list(scene.history.damaged) == [INDICES[1]]
    np.testing.assert_array_equal(scene.history.gaussians(INDICES[4]).means, whole.history.gaussians(INDICES[4]).means)


def test_what_cannot_be_resumed_is_said(undisturbed, tmp_path):
    kind = "masks, floor, image scale and exposures"
    _, base = undisturbed(kind)
    with pytest.raises(ResumeError, match="no committed frame"):
        resume(kind, tmp_path / "nothing")
    folder = copy_of(base, INDICES[2], tmp_path)
    for name in (f"frame_{INDICES[0]:06d}.npz", "first.copy.npz"):
        SPOILS["cut"](folder / name)
    with pytest.raises(ResumeError, match="first frame"):
        resume(kind, folder)


def test_the_process_ends_anywhere_in_a_commit(undisturbed, tmp_path):
    """Whatever of a commit's steps were done, the frame is there with its checkpoint, or neither counts."""
    kind = "without masks"
    whole, base = undisturbed(kind)
    after = base / f"after {INDICES[2]}"
    checkpoint, frame = f"checkpoint_{INDICES[2]:06d}.npz", f"frame_{INDICES[2]:06d}.npz"
    for done, copied in enumerate(([], [checkpoint], [checkpoint, frame])):
        folder = copy_of(base, INDICES[1], tmp_path / str(done))
        (folder / f".{frame}.77.part").write_bytes(b"half a file")
        (folder / f".{checkpoint}.77.part").write_bytes(b"half a file")
        for name in copied:
            shutil.copy(after / name, folder / name)
        scene = resume(kind, folder)
        assert scene.resumed.index == INDICES[2 if len(copied) == 2 else 1]
        assert scene.resumed.faults == []
        assert_same(whole, go_on(kind, scene))
        assert not list(folder.glob(".*"))


def test_frame_0_that_was_cut_short_starts_again(tmp_path, undisturbed):
    kind = "masks, floor, image scale and exposures"
    whole, base = undisturbed(kind)
    folder = tmp_path / "states"
    folder.mkdir()
    (folder / "fixed.npz").write_bytes(b"of a frame 0 that was never committed")
    shutil.copy(base / f"after {INDICES[0]}" / f"checkpoint_{INDICES[0]:06d}.npz", folder)
    assert len(History.open(folder)) == 0
    assert_same(whole, go_on(kind, begin(kind, folder)))
    assert History.load(folder).indices == INDICES


def test_a_checkpoint_cut_or_flipped_anywhere_is_refused_or_the_same(undisturbed, tmp_path):
    kind = "without masks"
    _, base = undisturbed(kind)
    source = base / f"after {INDICES[2]}" / f"checkpoint_{INDICES[2]:06d}.npz"
    content = source.read_bytes()
    factory = ViewFactory(RIG)
    truth = Checkpoints(source.parent).load(INDICES[2], factory)
    there = Checkpoints(tmp_path)
    file = tmp_path / source.name
    rng = np.random.default_rng(0)
    for cut in [*range(200), *rng.integers(200, len(content), 200), *range(len(content) - 200, len(content))]:
        file.write_bytes(content[:cut])
        with pytest.raises(CheckpointError):
            there.load(INDICES[2], factory)
    # Most bytes are pixels: the ends, with the directory of the zip and the headers, are gone through closely.
    refused = 0
    for place in [*range(300), *rng.integers(0, len(content), 300), *range(len(content) - 1500, len(content))]:
        flipped = bytearray(content)
        flipped[place] ^= 1 << int(rng.integers(8))
        file.write_bytes(flipped)
        try:
            found = there.load(INDICES[2], factory)
        except CheckpointError:
            refused += 1
            continue
        assert same_motion(found.motion, truth.motion)
        assert np.array_equal(found.labels, truth.labels)
        assert found.structure == truth.structure
        assert [view.name for view in found.seen] == [view.name for view in truth.seen]
        for a, b in zip(found.seen, truth.seen, strict=True):
            np.testing.assert_array_equal(a.target, b.target)
    assert refused > 1000


def test_a_failed_update_leaves_labels_and_motion_as_they_were(undisturbed, tmp_path, monkeypatch):
    """Learning what moves belongs to the frame: one that is not committed teaches nothing."""
    kind = "without masks"
    whole, _ = undisturbed(kind)
    scene = begin(kind, tmp_path / "states")
    change = KINDS[kind][1]
    with monkeypatch.context() as patch:

        def full(*_: object, **__: object) -> None:
            raise OSError("disk full")

        patch.setattr(History, "append", full)
        with pytest.raises(OSError, match="disk full"):
            scene.step(change(FRAMES[3]))
    assert_same(whole, go_on(kind, scene))


def test_reports_are_committed_with_the_states(undisturbed, tmp_path):
    kind = "masks, floor, image scale and exposures"
    _, base = undisturbed(kind)
    first = History.load(base / "live").report(INDICES[0])
    assert first["iterations"] == 12
    assert first["loss"]
    assert 5 < first["psnr"] < 60
    assert set(first["cameras"]) == set(RIG.names)
    assert first["masked"]
    scene = resume(kind, copy_of(base, INDICES[2], tmp_path))
    few = {name: image for name, image in FRAMES[3].images.items() if name in ("c0", "c2")}
    report = scene.step(replace(FRAMES[3], images=few), dropped={"c1": "not a picture"}, notes={"attempts": 2})
    stored = History.load(tmp_path / "states").report(INDICES[3])
    assert stored["used"] == ["c0", "c2"]
    assert stored["dropped"] == {"c1": "not a picture"}
    assert stored["attempts"] == 2
    assert stored["iterations"] == 4
    assert stored["loss"] == report.loss
    assert stored["psnr"] == report.psnr
    assert not stored["cold"]
    assert stored["threads"] >= 1
    assert stored["resumed"] == {"index": INDICES[2], "undone": [], "faults": [], "cold": False}


def test_retention_never_hinders_going_on(undisturbed, tmp_path):
    kind = "without masks"
    whole, base = undisturbed(kind)
    folder = copy_of(base, INDICES[0], tmp_path)
    scene = resume(kind, folder)
    for frame in FRAMES[1:]:
        scene.step(KINDS[kind][1](frame))
        scene.history.retain(last=1, size_bytes=1)
    kept = [INDICES[0], *INDICES[-2:]]
    assert_same(scene, resume(kind, folder), kept)
    SPOILS["cut"](folder / f"frame_{INDICES[-1]:06d}.npz")
    again = go_on(kind, resume(kind, folder))
    assert again.resumed.undone == [INDICES[-1]]
    for name, array in whole.history.gaussians(INDICES[-1]).arrays().items():
        np.testing.assert_array_equal(getattr(again.history.gaussians(INDICES[-1]), name), array)
