"""Compact files: written frame by frame, read in any order, while they are written, and after damage."""

from __future__ import annotations

import json
import tracemalloc
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import Camera, Rig, WorldFrame
from scas4d_core.compact import Bounds, CompactReader, CompactWriter, DamagedFileError, FileError, FileHeader
from scas4d_core.compact.columns import Columns
from scas4d_core.compact.encoder import KEY_EVERY
from scas4d_core.compact.frame_code import errors_of
from scas4d_core.compact.index import footer
from scas4d_core.compact.planes import compress
from scas4d_core.compact.records import HEAD_SIZE, RecordKind, parse_head, record_bytes, scan
from scas4d_core.gaussians import Gaussians, quaternion_products

RIG = Rig((Camera("front", [[100.0, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4), 64, 48),))
HEAD = FileHeader(WorldFrame(np.array([1.0, 2, 3]), 0.5), background=(0.1, 0.2, 0.3), rig=RIG, frames_per_second=30.0)
FRAMES = (0, 1, 2, 5, *range(6, 24))
BORN_AT, RETIRED_AT, REVIVED_AT = 5, 12, 18


def states() -> Iterator[tuple[int, float, Gaussians]]:
    """A cloud that drifts; some are born, some leave and come back."""
    rng = np.random.default_rng(0)
    state = Gaussians.of_points(rng.uniform(-1, 1, (250, 3)), 0.03, rng.uniform(size=(250, 3)))
    gloss, mirrored = rng.normal(0, 0.2, (200, 3)), rng.uniform(size=(2, 4, 3))
    state = state.replace(gloss=gloss.astype(np.float32), environment=mirrored.astype(np.float32))
    turn = Rotation.from_rotvec([0.0, 0.05, 0.0])
    for index in FRAMES:
        moved = turn.apply(state.means) + rng.normal(0, 0.01, state.means.shape) + [0.02, 0, 0]
        assert state.gloss is not None
        state = state.replace(
            means=moved.astype(np.float32),
            gloss=turn.apply(state.gloss).astype(np.float32),
            rotations=quaternion_products(
                np.tile(np.roll(turn.as_quat(), 1), (len(state), 1)), state.rotations.astype(float)
            ).astype(np.float32),
            colours=(state.colours + rng.normal(0, 0.01, state.colours.shape)).astype(np.float32),
        )
        if index == BORN_AT:
            born = Gaussians.of_points(rng.uniform(-1, 1, (40, 3)), 0.02)
            state = state.concatenate(born).replace(ids=np.concatenate([state.ids, 1000 + np.arange(40)]))
        if index == RETIRED_AT:
            state = state.retire([3, 260])
        if index == REVIVED_AT:
            state = state.revive([3])
        yield index, 0.1 * index, state


TRUE = {index: (time, state) for index, time, state in states()}


def write(path: Path, frames: tuple[int, ...] = FRAMES, close: bool = True) -> CompactWriter:
    writer = CompactWriter(path, HEAD)
    for index in frames:
        writer.add(index, *TRUE[index])
    if close:
        writer.add_parts(frames[-1], np.zeros(len(TRUE[frames[-1]][1]), np.int64))
        writer.add_parts(frames[-1], np.arange(len(TRUE[frames[-1]][1])) % 3 - 1)
        writer.close()
    return writer


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("compact") / "a.s4d"
    write(path)
    return path


def near(reader: CompactReader, index: int) -> None:
    state, true = reader.state(index), TRUE[index][1]
    errors = errors_of(Columns.of(state), Columns.of(true))
    limits = Bounds().record()
    assert all(value <= 1.001 * limits[name] for name, value in errors.items()), (index, errors)
    assert np.array_equal(state.ids, true.ids)
    assert np.array_equal(state.retired, true.retired)
    assert "gloss" in errors
    assert np.array_equal(state.environment, true.environment)
    assert np.allclose(np.linalg.norm(state.rotations, axis=1), 1, atol=1e-6)


def test_frames_are_read_in_any_order(file: Path) -> None:
    with CompactReader(file) as reader:
        assert reader.frames == list(FRAMES)
        assert reader.times.tolist() == [TRUE[index][0] for index in FRAMES]
        assert reader.count == 290
        for index in [*FRAMES, *reversed(FRAMES), *np.random.default_rng(1).permutation(FRAMES).tolist()]:
            near(reader, index)
        assert len(reader.state(2)) == 250
        assert len(reader.state(5)) == 290
        assert reader.parts() is not None
        assert reader.parts()[:4].tolist() == [-1, 0, 1, -1]
        assert reader.parts(3) is None


def test_the_same_bits_come_out_in_any_order(file: Path) -> None:
    with CompactReader(file) as forward, CompactReader(file) as backward:
        first = [forward.state(index) for index in FRAMES]
        for index, state in reversed(list(zip(FRAMES, first, strict=True))):
            again = backward.state(index)
            for name, array in state.arrays().items():
                assert np.array_equal(again.arrays()[name], array), (index, name)


def test_the_head_tells_what_numbers_mean(file: Path) -> None:
    with CompactReader(file) as reader:
        head = reader.head
        assert head.world.metres_per_unit == 0.5
        assert head.world.origin.tolist() == [1, 2, 3]
        assert head.background == (0.1, 0.2, 0.3)
        assert head.frames_per_second == 30
        assert head.rig is not None
        assert np.array_equal(head.rig["front"].intrinsics, RIG["front"].intrinsics)
        assert reader.about["errors"]["position"] <= 1.001 * head.bounds.position
        assert reader.about["errors"]["position"] > 0.5 * head.bounds.position


def test_keys_come_often_enough(file: Path) -> None:
    with file.open("rb") as opened:
        kinds = [record.kind for record in scan(opened, 0, "a")]
    told = [kind for kind in kinds if kind in (RecordKind.KEY, RecordKind.DELTA)]
    runs = "".join("k" if kind is RecordKind.KEY else "d" for kind in told).split("k")
    assert max(map(len, runs)) == KEY_EVERY - 1
    assert kinds[:2] == [RecordKind.HEAD, RecordKind.BORN]
    assert kinds[-2:] == [RecordKind.PARTS, RecordKind.INDEX]


def test_a_file_is_read_while_it_is_written(tmp_path: Path) -> None:
    writer = write(tmp_path / "a.s4d", FRAMES[:4], close=False)
    with CompactReader(tmp_path / "a.s4d") as reader:
        assert reader.frames == list(FRAMES[:4])
        assert reader.refresh() == []
        writer.add(FRAMES[4], *TRUE[FRAMES[4]])
        assert reader.refresh() == [FRAMES[4]]
        near(reader, FRAMES[4])
        writer.close()
        assert reader.refresh() == []
        assert reader.damage is None


def test_a_file_that_was_cut_is_read_up_to_the_cut(file: Path, tmp_path: Path) -> None:
    data = file.read_bytes()
    with file.open("rb") as opened:
        records = list(scan(opened, 0, "a"))
    rng = np.random.default_rng(0)
    for cut in sorted({*rng.integers(0, len(data), 60).tolist(), *(record.end for record in records)}):
        path = tmp_path / f"{cut}.s4d"
        path.write_bytes(data[:cut])
        states = [one for one in records if one.kind in (RecordKind.KEY, RecordKind.DELTA) or one.frame == 0]
        whole = [one.frame for one in states if one.end <= cut]
        if records[0].end > cut:
            with pytest.raises(FileError):
                CompactReader(path)
            continue
        with CompactReader(path) as reader:
            assert reader.frames == whole
            assert reader.damage is None
            if whole:
                near(reader, whole[-1])


def test_damage_is_named_with_its_place(file: Path, tmp_path: Path) -> None:
    data = bytearray(file.read_bytes())
    with file.open("rb") as opened:
        records = list(scan(opened, 0, "a"))
    hurt = next(record for record in records if record.frame == 9)
    data[hurt.offset + 30] ^= 1
    path = tmp_path / "a.s4d"
    path.write_bytes(data)
    with CompactReader(path) as reader:
        near(reader, 8)
        with pytest.raises(
            DamagedFileError, match=rf"a\.s4d: the delta record of frame 9 at byte {hurt.offset - HEAD_SIZE} is"
        ):
            reader.state(9)
        near(reader, 23)  # after the next key all is well
        near(reader, 8)


@pytest.mark.parametrize("indexed", [True, False])
def test_any_damage_is_an_error_or_the_truth(file: Path, tmp_path: Path, indexed: bool) -> None:
    """Bytes are changed, moved and lost at random; checksums are made right again for half of them."""
    whole = file.read_bytes() if indexed else file.read_bytes()[:-8]
    with file.open("rb") as opened:
        records = [record for record in scan(opened, 0, "a") if record.size]
    rng = np.random.default_rng(int(indexed))
    path = tmp_path / "a.s4d"
    said: set[str] = set()
    tracemalloc.start()
    for turn in range(50):
        data = bytearray(whole)
        record = records[int(rng.integers(len(records)))]
        for _ in range(int(rng.integers(1, 4))):
            place = int(rng.integers(record.offset, record.end))
            data[place] = int(rng.integers(256))
        if turn % 2:  # a hostile file: its checksums agree
            body = bytes(data[record.offset : record.end])
            data[record.offset - HEAD_SIZE : record.end] = record_bytes(record.kind, body, record.frame, record.time)
        if turn % 5 == 0:
            begin = int(rng.integers(len(data)))
            del data[begin : begin + int(rng.integers(1, 200))]
        path.write_bytes(data)
        try:
            with CompactReader(path) as reader, np.errstate(all="ignore"):
                reader.parts()
                for index in reader.frames:
                    try:
                        if turn % 2:
                            reader.state(index)
                        else:
                            near(reader, index)
                    except FileError as error:
                        said.add(str(error))
        except FileError as error:
            said.add(str(error))
    assert len(said) > 15
    assert all("a.s4d: " in text for text in said)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100e6


def test_a_file_that_begins_after_a_birth_is_glossy_still(tmp_path: Path) -> None:
    write(tmp_path / "a.s4d", tuple(index for index in FRAMES if index >= 8))
    with CompactReader(tmp_path / "a.s4d") as reader:
        for index in reader.frames:
            near(reader, index)
        assert reader.state(8).gloss is not None


def test_parts_of_many_take_few_bytes_and_are_read(tmp_path: Path) -> None:
    state = Gaussians.of_points(np.random.default_rng(0).uniform(-1, 1, (5000, 3)), 0.03)
    with CompactWriter(tmp_path / "a.s4d", HEAD) as writer:
        writer.add(0, 0.0, state)
        writer.add_parts(0, np.zeros(5000, np.int64))
    with CompactReader(tmp_path / "a.s4d") as reader:
        assert reader.parts() is not None
        assert reader.parts().tolist() == [0] * 5000


def test_a_lost_or_exchanged_record_is_noticed(file: Path, tmp_path: Path) -> None:
    data = file.read_bytes()
    with file.open("rb") as opened:
        records = list(scan(opened, 0, "a"))[:-2]
    pieces = [data[record.offset - HEAD_SIZE : record.end] for record in records]
    place = next(k for k, record in enumerate(records) if record.frame == 8)
    lost, exchanged = tmp_path / "lost.s4d", tmp_path / "exchanged.s4d"
    lost.write_bytes(b"".join(pieces[:place] + pieces[place + 1 :]))
    with CompactReader(lost) as reader, pytest.raises(DamagedFileError, match="a different previous state"):
        reader.state(records[place + 1].frame)
    pieces[place], pieces[place + 1] = pieces[place + 1], pieces[place]
    exchanged.write_bytes(b"".join(pieces))
    with CompactReader(exchanged) as reader:
        assert "unexpected frame 8 after frame 9" in str(reader.damage)
        near(reader, 7)


def test_parts_that_cannot_be_are_refused(tmp_path: Path) -> None:
    writer = write(tmp_path / "a.s4d", FRAMES[:4], close=False)
    for index, labels in ((FRAMES[3], np.zeros(7, np.int64)), (1, np.zeros(250, np.int64))):
        with pytest.raises(FileError, match="do not match"):
            writer.add_parts(index, labels)
    state = TRUE[6][1]
    for changed, says in (
        (state.replace(gloss=None), "gloss for 0 Gaussians"),
        (state.replace(opacities=state.own_opacities * np.float32(0.5)), "opacities"),
    ):
        with pytest.raises(FileError, match=says):
            writer.add(7, 0.7, changed)
    writer.close()


@pytest.mark.parametrize("index", [b"", b"abc", (5).to_bytes(4, "little") + b"junk", "json"])
def test_an_index_that_is_none_is_passed_over(file: Path, tmp_path: Path, index: bytes | str) -> None:
    with file.open("rb") as opened:
        records = list(scan(opened, 0, "a"))
    data = file.read_bytes()[: records[-1].offset - HEAD_SIZE]
    if index == "json":
        index = (0).to_bytes(4, "little") + compress(b"[" * 100_000)
    assert isinstance(index, bytes)
    path = tmp_path / "a.s4d"
    path.write_bytes(data + record_bytes(RecordKind.INDEX, index) + footer(len(data)))
    with CompactReader(path) as reader:
        assert reader.frames == list(FRAMES)
        near(reader, 12)


def test_a_head_that_is_no_json_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises((TypeError, ValueError)):
        CompactWriter(tmp_path / "a.s4d", FileHeader(WorldFrame(np.zeros(3)), metadata={"a": object()}))
    assert not list(tmp_path.iterdir())


def test_a_count_that_lies_fills_no_memory(tmp_path: Path) -> None:
    body = (2**31 - 1).to_bytes(4, "little") + bytes(9) * 40
    path = tmp_path / "a.s4d"
    path.write_bytes(record_bytes(RecordKind.HEAD, HEAD.text()) + record_bytes(RecordKind.BORN, body, 0))
    with CompactReader(path) as reader, pytest.raises(DamagedFileError, match="2147483647 Gaussians in 364 bytes"):
        reader.state(0)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (b"[]", "invalid header"),
        (b"{}", "invalid header"),
        (b"\xff", "invalid header"),
        (
            json.dumps(json.loads(HEAD.text()) | {"version": 99}).encode(),
            "version 99, but this version of scas4d reads version 1; use",
        ),
        (
            json.dumps(json.loads(HEAD.text()) | {"version": 0}).encode(),
            "version 0, but this version .* reads version 1",
        ),
        (json.dumps(json.loads(HEAD.text()) | {"world": {"origin": [0, 0], "metres_per_unit": 1}}).encode(), "invalid"),
        (
            json.dumps(json.loads(HEAD.text()) | {"world": {"origin": [0] * 3, "metres_per_unit": 0}}).encode(),
            "invalid",
        ),
        (json.dumps(json.loads(HEAD.text()) | {"cameras": [{"name": "a"}]}).encode(), "invalid"),
        (json.dumps(json.loads(HEAD.text()) | {"bounds": {"position": -1}}).encode(), "invalid"),
        (json.dumps(json.loads(HEAD.text()) | {"background": [10**400, 0, 0]}).encode(), "invalid"),
    ],
)
def test_heads_that_are_none_are_refused(text: bytes, says: str, tmp_path: Path) -> None:
    path = tmp_path / "a.s4d"
    path.write_bytes(record_bytes(RecordKind.HEAD, text))
    with pytest.raises(FileError, match=says):
        CompactReader(path)


def test_other_files_are_refused(tmp_path: Path) -> None:
    for data in (b"", b"ply\nformat", b"s4dR", b"s4dR" + bytes(200)):
        path = tmp_path / "a.s4d"
        path.write_bytes(data)
        with pytest.raises(FileError, match=r"a\.s4d(: | is not)"):
            CompactReader(path)
    with pytest.raises(FileNotFoundError):
        CompactReader(tmp_path / "none.s4d")


def test_a_record_of_a_later_version_is_named() -> None:
    data = bytearray(record_bytes(RecordKind.KEY, b"abc", 3))
    data[4] = 77
    data[HEAD_SIZE - 4 : HEAD_SIZE] = zlib.crc32(data[: HEAD_SIZE - 4]).to_bytes(4, "little")
    with pytest.raises(FileError, match="kind 77 at byte 12; a later version"):
        parse_head(bytes(data[:HEAD_SIZE]), 12, "a")


def test_frames_that_cannot_follow_are_refused(tmp_path: Path) -> None:
    writer = write(tmp_path / "a.s4d", FRAMES[:5], close=False)
    time, state = TRUE[FRAMES[5]]
    size = (tmp_path / "a.s4d").stat().st_size
    with pytest.raises(FileError, match="frame 6 cannot follow frame 6"):
        writer.add(6, time, state)
    with pytest.raises(FileError, match="lacks Gaussians of frame 6; do not remove or reorder any"):
        writer.add(7, time, state.rows(np.arange(100)))
    broken = state.means.copy()
    broken[4] = np.nan
    with pytest.raises(FileError, match=r"1 Gaussians have non-finite means, rows \[4\]"):
        writer.add(7, time, state.replace(means=broken))
    assert (tmp_path / "a.s4d").stat().st_size == size
    writer.add(7, time, state)
    writer.close()
    with pytest.raises(FileExistsError):
        CompactWriter(tmp_path / "a.s4d", HEAD)
    with pytest.raises(FileError, match="key_every must be at least 1; got 0"):
        CompactWriter(tmp_path / "b.s4d", HEAD, key_every=0)
    with (
        pytest.raises(FileError, match="frame 99 is not in the file; available frames: 0 to 7"),
        CompactReader(tmp_path / "a.s4d") as reader,
    ):
        reader.state(99)


def test_a_scene_without_gaussians_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="no Gaussian"), CompactWriter(tmp_path / "a.s4d", HEAD) as writer:
        writer.add(0, 0.0, TRUE[0][1].rows(np.zeros(0, np.intp)))


def test_without_clusters_a_file_tells_the_same(tmp_path: Path) -> None:
    for clustered in (False, True):
        with CompactWriter(tmp_path / f"{clustered}.s4d", HEAD, clustered=clustered) as writer:
            for index in (0, 1, 5):
                writer.add(index, *TRUE[index])
    with CompactReader(tmp_path / "False.s4d") as plain, CompactReader(tmp_path / "True.s4d") as grouped:
        assert (plain.state(0).means == grouped.state(0).means).all()
        assert max(errors_of(Columns.of(plain.state(5)), Columns.of(TRUE[5][1])).values()) < 0.07
