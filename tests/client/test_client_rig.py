"""The rig simulator against a real service: its pace, its losses, its senders, and a service that goes away."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import pytest
from running import Running, fake_settings
from waiting import HANG_S

from client.ingest import IngestSocket
from client.rig import Lateness, Pace, Sequence, push
from client.sdk import Client
from client.wire import IngestSettings
from scas4d_core.captures import open_capture


@pytest.fixture
def capture(capture_folder):
    return open_capture(capture_folder)


def test_losses_and_lateness_are_the_same_every_time():
    pace = Pace(fps=5, jitter=0.1, drop=0.3, seed=4)
    lost = [index for index in range(1000) if pace.drops(index)]
    assert lost == [index for index in range(1000) if Pace(fps=5, drop=0.3, seed=4).drops(index)]
    assert lost != [index for index in range(1000) if Pace(fps=5, drop=0.3, seed=5).drops(index)]
    assert 240 < len(lost) < 360
    assert 0 not in lost
    assert not Pace().drops(5)
    late = [pace.delay(index, "c") for index in range(1000)]
    assert all(0 <= value <= 0.1 for value in late)
    assert 0.045 < sum(late) / 1000 < 0.055


@pytest.mark.parametrize(("field", "value"), [("fps", 0), ("fps", -1), ("jitter", -1), ("drop", 1), ("drop", -0.1)])
def test_a_pace_that_cannot_be_is_named(field, value):
    with pytest.raises(ValueError, match=f"{field} must be .*; got {value}"):
        Pace(**{field: value})


def test_a_loop_goes_back_and_forth_and_time_only_forward(capture):
    sequence = Sequence(capture, start=1, loop=True)
    assert [sequence.capture_index(index) for index in range(9)] == [1, 2, 3, 2, 1, 2, 3, 2, 1]
    times = [sequence.time(index) for index in range(9)]
    assert times == pytest.approx([index / 30 for index in range(9)])
    assert sequence.files(3).images == {name: capture.encoded_image(2, name) for name in ("0", "1")}
    assert sequence.files(3).masks.keys() == {"0", "1"}
    sequence.close()
    once = Sequence(capture, start=1)
    assert len(once) == 3
    once.close()
    alone = Sequence(capture, start=3, loop=True)
    assert [alone.capture_index(index) for index in range(3)] == [3, 3, 3]
    alone.close()
    with pytest.raises(ValueError, match=r"start must be a frame of .*0…3; got 4"):
        Sequence(capture, start=4)


def test_the_next_frames_are_read_ahead_and_those_of_another_place_are_not_used(capture):
    sequence, read = Sequence(capture), []
    files = sequence._files
    sequence._files = lambda index: read.append(index) or files(index)
    first = sequence.files(0)
    sequence._reader.submit(int).result()  # after what was asked for
    assert read == [0, 1, 2]
    assert sequence.files(0).images == first.images
    assert sequence.files(3).time == capture.time(3)
    sequence.close()
    assert read[-1] == 3


def test_the_summary_says_how_far_behind():
    lateness = Lateness(late=[-0.1, -0.1, 0.4], busy=1.5, busy_count=2, outage=3, outage_count=4, began=0, ended=2)
    said = lateness.summary(5)
    assert "sent 3 frames at 1.00 of 5 per second" in said
    assert "1 acknowledged after the next frame was due, by at most 0.40 s" in said
    assert "1.5 s for space in the queue (2 times)" in said
    assert "3.0 s for the service (4 retries)" in said
    assert Lateness().summary(None) == "sent 0 frames"
    first = Lateness(late=[40.0, -0.1, -0.1, 0.4], began=40, ended=42, before=1)
    assert "sent 4 frames, those after frame 0 at 1.00 of 5 per second; 1 acknowledged after" in first.summary(5)


@pytest.mark.parametrize("websocket", [False, True])
def test_a_rig_that_loses_frames_goes_on(client, capture, websocket):
    said = []
    pace = Pace(drop=0.5, seed=1)
    delivery = push(capture, client, pace=pace, frames=20, loop=True, websocket=websocket, on_message=said.append)
    lost = [index for index in range(20) if pace.drops(index)]
    assert delivery.lost == lost != []
    states = [client.frame(delivery.scene, index).state for index in range(20)]
    assert states == ["missing" if index in lost else "committed" for index in range(20)]
    assert len(said) == len(lost)
    assert len(delivery.lateness.late) == 20


@pytest.mark.parametrize("websocket", [False, True])
def test_each_camera_sends_its_own(client, capture, websocket):
    pace = Pace(drop=0.3, seed=2, jitter=0.02)
    delivery = push(
        capture,
        client,
        pace=pace,
        frames=8,
        loop=True,
        per_camera=True,
        websocket=websocket,
        ingest=IngestSettings(minimum_cameras=1),
    )
    for index in range(8):
        lost = [name for name in ("0", "1") if pace.drops(index, name)]
        report = client.frame(delivery.scene, index)
        assert report.state == ("missing" if len(lost) == 2 else "committed")
        if len(lost) == 1:
            assert report.used_cameras == [name for name in ("0", "1") if name not in lost]
    assert delivery.status.committed > 0


def test_a_scene_is_gone_on_with(client, capture):
    first = push(capture, client, frames=2)
    said = []
    second = push(capture, client, scene=first.scene, on_message=said.append)
    assert second.scene == first.scene
    assert second.status.committed == 4
    assert len(second.lateness.late) == 2
    assert said == [f"scene {first.scene} continues with frame 2"]
    assert client.frame(first.scene, 3).time == pytest.approx(3 / 30)
    again = push(capture, client, scene=first.scene)
    assert again.lateness.late == []


def test_a_scene_has_a_printable_name_of_at_most_200_characters(client, capture):
    folder = "take\x1b[31m\n7\udcff" + "é" * 230
    name = push(replace(capture, name=folder), client, frames=1).status.name
    assert name.startswith("take\\x1b[31m\\n7\\udcffé")
    assert len(name) == 200


def test_a_scene_of_another_rig_is_refused(client, capture):
    from running import make_rig

    scene = client.create_scene(make_rig())
    with pytest.raises(RuntimeError, match=r"has the cameras c0, c1, but tiny has 0, 1"):
        push(capture, client, scene=scene.id)


def test_after_a_gap_it_goes_on_where_the_service_says(client, capture):
    """Somebody else declares a frame missing while the rig sends: the rig's own next frame is not next any more."""
    said = []

    def meddle(stage, done, total):
        if stage == "frames" and client.scene(scene_id()).next_frame == 2:
            client.declare_missing(scene_id(), 2, "by somebody else")

    def scene_id():
        return client.scenes()[0].id

    delivery = push(capture, client, on_progress=meddle, on_message=said.append)
    assert [client.frame(delivery.scene, index).state for index in range(4)] == [
        "committed",
        "committed",
        "missing",
        "committed",
    ]
    assert any("expects frame 3 next, not 2" in sentence for sentence in said)


def test_a_full_queue_is_waited_for_and_counted(client, capture):
    """The scene rests after its first frame, until the rig has heard that there is no room."""

    def rest(stage, done, total):
        if stage == "frames" and not heard:
            client.pause(client.scenes()[0].id)

    def go_on(retry):
        if not heard:
            client.resume(client.scenes()[0].id)
        heard.append(retry.reason)

    heard = []
    client.on_retry = go_on
    delivery = push(capture, client, frames=12, loop=True, on_progress=rest, ingest=IngestSettings(queue_frames=1))
    assert delivery.status.committed == 12
    assert heard == ["busy"] * delivery.lateness.busy_count != []
    assert delivery.lateness.busy > 0


def test_a_restart_of_the_service_is_waited_out(capture, tmp_path):
    """The service ends after a few frames and comes back a second later: nothing is lost, nothing twice."""
    settings = fake_settings(tmp_path)
    running = Running(settings)
    back = []

    def restart():
        running.stop()
        time.sleep(1)
        back.append(Running(settings, running.port))

    restarting = threading.Thread(target=restart)
    said = []

    def told(stage, done, total):
        if stage == "frames" and done >= 2 and not restarting.is_alive() and not back:
            restarting.start()

    try:
        with Client(running.url, outage=HANG_S, busy_timeout=HANG_S) as client:
            delivery = push(
                capture, client, pace=Pace(fps=10), frames=20, loop=True, on_progress=told, on_message=said.append
            )
            restarting.join()
            assert [client.frame(delivery.scene, index).state for index in range(20)] == ["committed"] * 20
        assert delivery.lateness.outage_count > 0
        assert any("is unavailable" in sentence for sentence in said)
    finally:
        for service in back or [running]:
            service.stop()


@pytest.mark.parametrize("websocket", [False, True])
def test_a_rig_sends_several_frames_at_once(service, capture_folder, monkeypatch, websocket):
    sent = []
    sender = IngestSocket if websocket else Client
    put_frames = sender.put_frames

    def recorded(self, *arguments, **named):
        sent.append([frame.index for frame in arguments[-1]])
        return put_frames(self, *arguments, **named)

    monkeypatch.setattr(sender, "put_frames", recorded)
    pace = Pace(drop=0.4, seed=next(seed for seed in range(99) if _drops(seed) == {5}))
    with Client(service.url) as client:
        delivery = push(
            open_capture(capture_folder), client, batch=2, frames=8, loop=True, pace=pace, websocket=websocket
        )
        assert sent == [[1, 2], [3, 4], [6, 7]]  # frame 0 goes alone, and the lost frame 5 is declared missing
        assert delivery.lost == [5]
        assert (delivery.status.committed, delivery.status.missing) == (7, 1)
        assert len(delivery.lateness.late) == 8
        client.delete_scene(delivery.scene)
        with pytest.raises(ValueError, match="batch must be"):
            push(open_capture(capture_folder), client, batch=2, per_camera=True)


def _drops(seed):
    return {index for index in range(8) if Pace(drop=0.4, seed=seed).drops(index)}
