"""Decoding in advance: a frame that was announced is decoded once, whatever is announced before it is taken."""

from __future__ import annotations

import pytest
from running import make_rig, picture

from scas4d_core.captures import Frame
from server.messages import FrameReady
from server.processes.decoder import Encoded, FrameDecoder
from server.storage.frame_store import FrameDamage


class Counting(FrameDecoder):
    """Decoder that counts what it decodes."""

    def __init__(self, tmp_path):
        super().__init__(make_rig(), tmp_path)
        self.decoded = []

    def _decode(self, message):
        self.decoded.append(message.index)
        if message.index == 13:
            raise FrameDamage("damaged")
        return Frame(message.index, message.time, {}, {}), {}


@pytest.fixture
def decoder(tmp_path):
    return Counting(tmp_path)


def ready(index, identity="x"):
    return FrameReady(index, index / 10, (f"{index}.frame",), identity)


def test_a_frame_is_decoded_once_though_the_next_one_is_announced_before_it_is_taken(decoder):
    for index in range(1, 6):
        decoder.begin(ready(index))
        decoder.begin(ready(index + 1))
        assert decoder.decode(ready(index))[0].index == index
        decoder._ahead.pop(next(iter(decoder._ahead))).result()
    assert sorted(decoder.decoded) == [1, 2, 2, 3, 3, 4, 4, 5, 5, 6]


def test_a_live_stream_decodes_nothing_twice(decoder):
    decoder.begin(ready(1))
    for index in range(1, 9):
        decoder.begin(ready(index + 1))
        assert decoder.decode(ready(index))[0].index == index
    decoder.decode(ready(9))
    assert decoder.decoded == list(range(1, 10))


def test_frames_that_were_announced_in_vain_do_not_pile_up(decoder):
    for index in range(20):
        decoder.begin(ready(index))
    assert len(decoder._ahead) == 2
    assert decoder.decode(ready(30))[0].index == 30


def test_other_content_under_the_same_index_is_decoded(decoder):
    decoder.begin(ready(4, "before"))
    decoder.decode(ready(4, "after"))
    assert decoder.decoded.count(4) == 2


def test_damage_is_reported_when_the_frame_is_taken(decoder):
    decoder.begin(ready(13))
    with pytest.raises(FrameDamage):
        decoder.decode(ready(13))


def test_an_image_that_cannot_be_decoded_leaves_its_camera_out(tmp_path):
    """Ingest refuses such images; frame logs of earlier versions may contain them."""
    encoded = Encoded({"c0": memoryview(picture()), "c1": memoryview(picture()[:-9])}, {}, [])
    frame, dropped = FrameDecoder(make_rig(), tmp_path).decode_images(ready(1), encoded)
    assert list(frame.images) == ["c0"]
    assert dropped["c1"].startswith("image of camera 'c1': the PNG file is truncated")
