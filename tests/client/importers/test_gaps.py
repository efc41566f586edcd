"""A rig is whole, or the gap is named: cameras of the calibration and images on disk are compared; names are kept."""

from __future__ import annotations

import json
import unicodedata

import numpy as np
import pytest
from lenses import HEIGHT, WIDTH
from PIL import Image
from rigs import NAMES, anipose, easymocap, lenses, transforms, write, write_pictures

from client.importers.calibration import can_be_named, service_names
from client.importers.open_source import open_source, read_calibration
from scas4d_core.captures import CaptureError, ImageError

ORDERED = ("cam1", "cam2", "cam10")


def flat_pictures(folder, names=NAMES):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        Image.new("RGB", (WIDTH, HEIGHT)).save(folder / f"{name}.png")


def write_model(rig, folder, points):
    """A COLMAP model as text; `points` is the line after each image, or None for no line."""
    folder.mkdir(parents=True)
    cameras, images = ["# Camera list"], ["# Image list"]
    for number, (name, lens) in enumerate(rig.items(), 1):
        k, pose = lens.intrinsics, lens.world_to_camera
        cameras.append(f"{number} PINHOLE {WIDTH} {HEIGHT} {k[0, 0]} {k[1, 1]} {k[0, 2]} {k[1, 2]}")
        half = np.arctan2(pose[0, 2], pose[0, 0]) / 2  # the cameras of `lenses` are turned about y
        words = [number, np.cos(half), 0.0, np.sin(half), 0.0, *pose[:3, 3], number, f"{name}.png"]
        images += [" ".join(map(str, words)), *([] if points is None else [points])]
    (folder / "cameras.txt").write_text("\n".join(cameras) + "\n")
    (folder / "images.txt").write_text("\n".join(images) + "\n")


POINTS2D = "10.5 20.25 -1 30 40.5 17 50.0 60.0 3"


@pytest.mark.parametrize("points", [None, "", POINTS2D])
def test_every_camera_of_images_txt_is_read(tmp_path, points):
    rig = lenses("PINHOLE")
    write_model(rig, tmp_path / "sparse/0", points)
    found = read_calibration(tmp_path)
    assert found.names == ORDERED
    for lens in found.cameras:
        assert np.allclose(lens.world_to_camera, rig[lens.name].world_to_camera)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("layout", ["colmap", "transforms", "anipose", "easymocap"])
def test_text_with_any_line_ends_and_a_byte_order_mark_is_read(tmp_path, encoding, end, layout):
    rig = lenses("PINHOLE")
    if layout == "colmap":
        write_model(rig, tmp_path / "sparse/0", POINTS2D)
    elif layout == "transforms":
        (tmp_path / "transforms.json").write_text(json.dumps(transforms(rig, "PINHOLE"), indent=1))
    elif layout == "anipose":
        (tmp_path / "calibration.toml").write_text(anipose(rig))
    else:
        pytest.importorskip("yaml")
        easymocap(rig, tmp_path, sizes=True)
    for path in tmp_path.rglob("*"):
        if path.is_file():
            path.write_bytes(path.read_text().replace("\n", end).encode(encoding))
    found = read_calibration(tmp_path)
    assert found.names == ORDERED
    for lens in found.cameras:
        assert np.allclose(lens.world_to_camera, rig[lens.name].world_to_camera)


def test_of_several_models_the_largest_is_read_and_all_are_named(tmp_path):
    rig = lenses("PINHOLE")
    write_model({name: rig[name] for name in ("cam2", "cam1")}, tmp_path / "sparse/0", "")
    write_model(rig, tmp_path / "sparse/1", "")
    write_model({"cam2": rig["cam2"]}, tmp_path / "sparse/10", "")
    flat_pictures(tmp_path / "images")
    source = open_source(tmp_path)
    assert source.rig.names == ORDERED
    assert source.remarks == (
        "found 3 COLMAP models (sparse/0 with 2 images, sparse/1 with 3 images, sparse/10 with 1 images); using "
        "sparse/1, which has the most images; choose another with --calibration",
    )
    chosen = open_source(tmp_path, calibration=tmp_path / "sparse/0")
    assert chosen.rig.names == ("cam1", "cam2")
    assert chosen.remarks == ("skipped images that are not in 0: cam10.png",)


def test_a_camera_without_images_is_left_out_with_a_remark(tmp_path):
    write(tmp_path / "transforms.json", transforms(lenses("PINHOLE"), "PINHOLE"))
    write_pictures(tmp_path / "images", names=("cam1", "cam10"))
    source = open_source(tmp_path)
    assert source.rig.names == ("cam1", "cam10")
    assert source.remarks == ("skipped cameras that have no images in images: cam2",)


def test_cameras_without_a_pose_are_left_out(tmp_path):
    meta = transforms(lenses("PINHOLE"), "PINHOLE")
    del meta["frames"][1]["transform_matrix"]
    write(tmp_path / "transforms.json", meta)
    found = read_calibration(tmp_path)
    assert (found.names, found.remarks) == (("cam1", "cam2"), ("skipped cameras that have no pose: cam10",))
    (tmp_path / "transforms.json").unlink()
    lines = anipose(lenses("PINHOLE")).splitlines()
    first = [line for line in lines[:7] if not line.startswith(("rotation", "translation"))]
    (tmp_path / "calibration.toml").write_text("\n".join(first + lines[7:]))
    found = read_calibration(tmp_path)
    assert (found.names, found.remarks) == (
        ("cam1", "cam10"),
        ("calibration.toml: skipped cameras that have no pose: cam2",),
    )
    write_pictures(tmp_path / "images")  # cam2 is known to be left out
    assert open_source(tmp_path).remarks == found.remarks
    (tmp_path / "calibration.toml").write_text("\n".join(first))
    with pytest.raises(
        CaptureError, match=r"calibration.toml: none of its 1 cameras has a pose; calibrate the rig's extrinsics"
    ):
        read_calibration(tmp_path)


@pytest.mark.parametrize("names", [("22139900", "22139901", "1e3"), ("00", "01", "10"), ("true", "no", "0x1F")])
def test_names_that_yaml_takes_for_values_are_kept(tmp_path, names):
    pytest.importorskip("yaml")
    easymocap(dict(zip(names, lenses("PINHOLE").values(), strict=True)), tmp_path, sizes=True)
    for file in (tmp_path / "intri.yml", tmp_path / "extri.yml"):
        file.write_text(file.read_text().replace('"', ""))
    write_pictures(tmp_path / "images", names=names)
    source = open_source(tmp_path)
    assert set(source.rig.names) == set(names)
    assert source.remarks == ()


def test_names_of_people_are_mapped_with_a_remark(tmp_path):
    """macOS stores file names with separate accents; calibration tools write them as one letter."""
    labels = ("GoPro #4", "Kamera Süd", "time")
    rig = dict(zip(labels, lenses("PINHOLE").values(), strict=True))
    (tmp_path / "calibration.toml").write_text(anipose(rig))
    write_pictures(tmp_path / "images", names=[unicodedata.normalize("NFD", label) for label in labels])
    write_pictures(tmp_path / "masks", names=labels)
    source = open_source(tmp_path, test=("GoPro #4",))
    assert (source.rig.names, source.test_rig.names) == (("Kamera_Sud", "camera_time"), ("GoPro_4",))
    assert source.frame(0).images["Kamera_Sud"][0, 0].tolist() == [40, 0, 99]
    assert source.encoded_mask(0, "Kamera_Sud") is not None
    (remark,) = source.remarks
    assert "'GoPro #4' is now 'GoPro_4', 'Kamera Süd' is now 'Kamera_Sud', 'time' is now 'camera_time'" in remark


@pytest.mark.parametrize(
    "labels",
    [
        ["a b", "a_b", "a#b", "a b"],
        ["カメラ1", "カメラ2", "東", "西"],
        ["mask.x", ".hidden", "-dash", "../up", "", "x" * 80, "x" * 90],
    ],
)
def test_mapped_names_are_unique_and_accepted(labels):
    names = service_names(labels)
    assert list(names) == list(dict.fromkeys(labels))
    assert len(set(names.values())) == len(names)
    assert all(can_be_named(name) for name in names.values())
    assert all(name == label for label, name in names.items() if can_be_named(label))


@pytest.mark.parametrize("root", ["images", "frames", "."])
def test_one_folder_a_frame(tmp_path, root):
    (tmp_path / "calibration.toml").write_text(anipose(lenses("PINHOLE")))
    write_pictures(tmp_path / root, names=("f1", "f2", "f10"), frames=NAMES)
    source = open_source(tmp_path)
    assert (source.rig.names, source.frame_count, source.remarks) == (ORDERED, 3, ())
    assert [source.frame(t).images["cam2"][0, 0, 0] for t in range(3)] == [0, 40, 80]
    (tmp_path / root / "f2" / "cam2.png").unlink()
    with pytest.raises(ImageError, match=r"camera 'cam2' has no image that belongs to .*f2/cam1.png"):
        open_source(tmp_path).frame(1).images["cam2"]


def test_one_folder_a_frame_in_the_calibration(tmp_path):
    rig = lenses("PINHOLE")
    frames = [transforms(rig, "PINHOLE", path=f"images/{t:06d}/{{}}.png")["frames"] for t in range(2)]
    write(tmp_path / "transforms.json", transforms(rig, "PINHOLE") | {"frames": [*frames[0], *frames[1]]})
    write_pictures(tmp_path / "images", names=("000000", "000001"), frames=NAMES)
    source = open_source(tmp_path)
    assert (source.rig.names, source.frame_count) == (ORDERED, 2)


def absolute(rig):
    return transforms(rig, "PINHOLE", path="/home/someone/rig/images/{}/000000.png")


def on_windows(rig):
    return transforms(rig, "PINHOLE", path="D:\\rig\\images\\{}\\000000.png")


def upwards(rig):
    return transforms(rig, "PINHOLE", path="../images/{}/000000.png")


def without_extension(rig):
    return transforms(rig, "PINHOLE", path="./images/{}/000000")


@pytest.mark.parametrize("dialect", [absolute, on_windows, upwards, without_extension])
@pytest.mark.parametrize("flat", [False, True])
def test_paths_of_other_machines_and_without_extension(tmp_path, dialect, flat):
    rig = lenses("PINHOLE")
    meta = dialect(rig)
    for frame in meta["frames"] if flat else []:
        frame["file_path"] = frame["file_path"].replace("/000000", "").replace("\\000000", "")
    for key in ("w", "h", "cx", "cy", "fl_y"):  # as in instant-ngp's files
        del meta[key]
    write(tmp_path / "transforms.json", meta)
    flat_pictures(tmp_path / "images") if flat else write_pictures(tmp_path / "images")
    source = open_source(tmp_path)
    assert (source.rig.names, source.frame_count, source.remarks) == (ORDERED, 1 if flat else 2, ())
    assert source.rig.cameras[0].intrinsics.tolist() == [[210, 0, WIDTH / 2], [0, 210, HEIGHT / 2], [0, 0, 1]]


def test_cameras_of_other_splits_are_held_out(tmp_path):
    rig = lenses("PINHOLE")
    for split, names in (("train", ("cam1", "cam2")), ("test", ("cam10", "cam1"))):
        meta = transforms({name: rig[name] for name in names}, "PINHOLE", path="./images/{}/000000")
        write(tmp_path / f"transforms_{split}.json", meta)
    write_pictures(tmp_path / "images")
    source = open_source(tmp_path)
    assert (source.rig.names, source.test_rig.names) == (("cam1", "cam2"), ("cam10",))
    assert source.remarks == (
        "read transforms_train.json, transforms_test.json",
        "held out for evaluation, as they are not in transforms_train.json: cam10",
    )


def test_splits_with_folders_of_their_own(tmp_path):
    """Blender's layout: the images of a split lie in a folder that is called like it."""
    rig = lenses("PINHOLE")
    for split, names in (("train", ("cam1", "cam2")), ("test", ("cam10",))):
        meta = transforms({name: rig[name] for name in names}, "PINHOLE", path=f"./{split}/{{}}")
        write(tmp_path / f"transforms_{split}.json", meta)
        flat_pictures(tmp_path / split, names)
    source = open_source(tmp_path)
    assert (source.rig.names, source.test_rig.names, source.frame_count) == (("cam1", "cam2"), ("cam10",), 1)


def test_images_of_several_times_in_one_folder(tmp_path):
    """N3DV as 4D Gaussian methods convert it: images/cam00_0000.png with a time."""
    rig, frames = lenses("PINHOLE"), []
    for t in range(2):
        of_time = transforms(rig, "PINHOLE", path=f"images/{{}}_{t:04d}")["frames"]
        frames += [frame | {"time": t / 30} for frame in of_time]
        flat_pictures(tmp_path / "images", [f"{name}_{t:04d}" for name in NAMES])
    write(tmp_path / "transforms_train.json", transforms(rig, "PINHOLE") | {"frames": frames})
    source = open_source(tmp_path)
    assert (source.rig.names, source.frame_count, source.time(1)) == (ORDERED, 2, pytest.approx(1 / 30))


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        ("notes.xml", "<rig><camera/></rig>", r"none of its files is a known calibration \(notes.xml\); known layouts"),
        ("rig.xml", "<rig><camera></rig>", r"rig.xml cannot be read as XML"),
        ("rig.json", "{", r"rig.json is not valid JSON"),
        ("rig.xcp", "<Cameras/>", r"rig.xcp is a Vicon calibration, which is not read.*Pose2Sim"),
        ("rig.csv", "#name,x,y,alt,heading,pitch,roll,f", r"rig.csv is possibly RealityCapture .*COLMAP model"),
    ],
)
def test_a_layout_that_is_not_known_is_told_as_that(tmp_path, file, text, said):
    write_pictures(tmp_path / "images")
    (tmp_path / file).write_text(text)
    with pytest.raises(CaptureError, match=said) as caught:
        open_source(tmp_path)
    assert "unknown capture layout" in str(caught.value)
    assert "calibrate" not in str(caught.value)  # nothing is known of the calibration
    assert "Metashape's cameras (*.xml)" in str(caught.value)
    with pytest.raises(CaptureError, match=r"is no calibration in a known format"):
        open_source(tmp_path, calibration=tmp_path / file)
