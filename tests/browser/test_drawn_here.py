"""Views that the page draws itself: who draws when, what the service is asked for meanwhile, and the fallback."""

from __future__ import annotations

import io

import numpy as np
import pytest
from browser_page import FRAMES, canvas, expect, opened, push, shown, start_scene, until
from PIL import Image
from waiting import HANG_S

from client.sdk import Client
from client.wire import IngestSettings
from client.wire.stream import unpack

HERE = "document.getElementById('view').dataset.drawn === 'here'"
BY_THE_SERVICE = "document.getElementById('view').dataset.drawn === 'service'"


def seen(page):
    box = page.locator("#view").bounding_box()
    clip = {"x": box["x"] + 8, "y": box["y"] + 40, "width": box["width"] - 16, "height": box["height"] - 80}
    return np.array(Image.open(io.BytesIO(page.screenshot(clip=clip))).convert("RGB")).astype(int)


def turn(page, times=4):
    page.focus("#overlay")
    for _ in range(times):
        page.keyboard.press("ArrowLeft")


@pytest.fixture
def sent(page):
    """What the page sends to the stream."""
    messages = []
    page.on("websocket", lambda socket: socket.on("framesent", lambda data: messages.append(str(data))))
    return messages


def test_what_moves_is_drawn_here_and_what_rests_by_the_service(page, service, finished, sent):
    opened(page, service, finished)
    shown(page, frame=str(FRAMES - 1), drawn="service")
    turn(page)  # asks for the frame
    until(page, "document.getElementById('drawn') !== null")
    page.wait_for_timeout(600)
    before = len(sent)
    turn(page, 1)
    until(page, HERE)
    expect(page.locator("#drawn")).to_be_visible()
    until(page, BY_THE_SERVICE)
    expect(page.locator("#drawn")).to_be_hidden()
    assert len([one for one in sent[before:] if '"render"' in one]) == 1  # the exact picture, at rest
    assert page.faults == []


def test_here_alone_the_service_is_asked_for_no_picture(page, service, finished, sent):
    opened(page, service, finished)
    shown(page, drawn="service")
    page.select_option("#who", "here")
    until(page, HERE)
    first = seen(page)
    assert first.max() > 40  # the points, as blobs
    before = len(sent)
    turn(page)
    page.wait_for_timeout(500)
    assert np.abs(seen(page) - first).mean() > 0.1
    page.locator("#time").fill("2")
    shown(page, frame="2", drawn="here")
    page.keyboard.press("2")
    shown(page, mode="depth", drawn="here")
    assert float(page.locator("#near").inner_text()) > 1
    page.keyboard.press("4")
    shown(page, mode="alpha", drawn="here")
    assert not [one for one in sent[before:] if '"render"' in one or '"update"' in one]
    page.keyboard.press("3")
    shown(page, mode="parts", drawn="service")  # exact, which only the service can
    page.keyboard.press("1")
    shown(page, mode="colour", drawn="here")
    assert page.faults == []


def test_playing_slowly_shows_what_is_between_frames(page, service, finished):
    opened(page, service, finished, 0)
    shown(page, frame="0")
    page.select_option("#who", "here")
    until(page, HERE)
    page.select_option("#speed", "0.1")
    page.click("#play")  # a second a frame
    view, found = page.locator("#view"), {}
    for _ in range(200):  # on a busy machine few pictures are seen of a frame, of some none
        frame, picture = view.get_attribute("data-frame"), seen(page)
        if frame == view.get_attribute("data-frame"):
            found.setdefault(frame, []).append(picture)
        if any(np.abs(one[0] - one[-1]).mean() > 0.02 for one in found.values()):
            break
        page.wait_for_timeout(50)
    else:
        raise AssertionError("no two pictures of one frame differ")
    page.click("#play")
    assert page.faults == []


def test_frames_are_drawn_from_the_compact_files_of_the_scene(page, service):
    """Its answers end where a file of the service does, and begin with frames by which others are told."""
    with Client(service.url, busy_timeout=HANG_S) as sdk:
        id = start_scene(sdk, "long", ingest=IngestSettings(exact_states=24))
        for index in range(30):
            push(sdk, id, index)
        sdk.wait(id, 29)
        for frame in (3, 28, 1):  # the page asks for 24 frames at once: 0, then 1 to 5, then those that are exact
            opened(page, service, id, frame)
            page.reload()
            page.select_option("#who", "here")
            shown(page, frame=str(frame), drawn="here")
        sdk.delete_scene(id)
    assert [fault for fault in page.faults if "404" not in fault] == []


def test_a_new_frame_is_drawn_live(page, service):
    with Client(service.url, busy_timeout=HANG_S) as sdk:
        id = start_scene(sdk, "growing")
        push(sdk, id, 0)
        sdk.wait(id, 0)
        opened(page, service, id)
        shown(page, frame="0")
        page.select_option("#who", "here")
        shown(page, frame="0", drawn="here")
        first = seen(page)
        push(sdk, id, 1)
        shown(page, frame="1", drawn="here")
        page.wait_for_timeout(300)
        assert np.abs(seen(page) - first).mean() > 0.05
        sdk.delete_scene(id)
    assert [fault for fault in page.faults if "404" not in fault] == []


def live_messages(page):
    """Headers of the binary messages with live states that the page receives."""
    heads = []

    def took(data):
        if isinstance(data, bytes) and (head := unpack(data)[0]).type == "states":
            heads.append(head)

    page.on("websocket", lambda socket: socket.on("framereceived", took))
    return heads


def test_a_live_take_is_drawn_from_the_stream_and_between_its_states(page, service, sent):
    fetched, heads = [], live_messages(page)
    page.on("request", lambda request: fetched.append(request.url) if "states.s4d" in request.url else None)
    page.add_init_script("""
      window.drawn = [];
      const post = Worker.prototype.postMessage;
      Worker.prototype.postMessage = function (message, ...rest) {
        if (message.kind === 'draw') window.drawn.push(message);
        return post.call(this, message, ...rest);
      };
    """)
    with Client(service.url, busy_timeout=HANG_S) as sdk:
        id = start_scene(sdk, "live")
        push(sdk, id, 0)
        sdk.wait(id, 0)
        opened(page, service, id)
        shown(page, frame="0", drawn="service")
        assert not any('"states"' in message for message in sent)  # the scene may be finished
        for index in range(1, 8):
            push(sdk, id, index)
            shown(page, frame=str(index))
        until(page, BY_THE_SERVICE)  # the exact picture, once no further frame comes
        assert fetched == []
        assert [head.after for head in heads] == [None, *(head.frame for head in heads[:-1])]
        assert heads[-1].frame == 7
        drawn = page.evaluate("window.drawn")
        assert any(0 < one["share"] < 1 and one["next"] == one["index"] + 1 for one in drawn)
        expect(page.locator("#latency")).to_contain_text("drawn", use_inner_text=True)
        page.locator("#time").fill("2")
        shown(page, frame="2")
        until(page, "document.getElementById('live').getAttribute('aria-pressed') === 'false'")
        assert any('"unsubscribe"' in message for message in sent)
        sdk.delete_scene(id)
    assert [fault for fault in page.faults if "404" not in fault] == []


def test_after_a_broken_connection_live_states_start_anew(page, service):
    heads = live_messages(page)
    page.add_init_script("""
      window.sockets = [];
      const Plain = WebSocket;
      window.WebSocket = class extends Plain { constructor(...all) { super(...all); window.sockets.push(this); } };
    """)
    with Client(service.url, busy_timeout=HANG_S) as sdk:
        id = start_scene(sdk, "broken")
        push(sdk, id, 0)
        sdk.wait(id, 0)
        opened(page, service, id)
        page.select_option("#who", "here")
        shown(page, frame="0", drawn="here")
        page.evaluate("window.sockets.at(-1).close()")
        until(page, "window.sockets.length === 2 && window.sockets[1].readyState === WebSocket.OPEN")
        push(sdk, id, 1)
        shown(page, frame="1", drawn="here")
        assert heads[0].after is None
        assert heads[-1].frame == 1
        assert [head.after for head in heads].count(None) == 2
        sdk.delete_scene(id)
    assert [fault for fault in page.faults if "404" not in fault] == []


def test_a_live_state_that_does_not_continue_the_last_one_is_ignored(page, service):
    page.goto(service.url)
    taken = page.evaluate(
        """async () => {
          const { Here } = await import('/viewer/view/here.js');
          const here = new Here(document.createElement('canvas'), { drawn() {}, arrived() {}, parts() {} });
          const taken = [];
          here.splats = { addLive: () => taken.push(here.live.frame) };
          here.receive({ frame: 4, after: 3 });  // of a subscription that has ended
          here.receive({ frame: 5 });
          here.receive({ frame: 7, after: 5 });
          here.receive({ frame: 8, after: 6 });
          return [...taken, here.live.frame];
        }"""
    )
    assert taken == [None, 5, 7]


def test_the_motion_between_live_states_ends_when_the_next_is_expected(page, service):
    page.goto(service.url)
    moments = page.evaluate(
        """async () => {
          const { Here } = await import('/viewer/view/here.js');
          const here = new Here(document.createElement('canvas'), { drawn() {}, arrived() {}, parts() {} });
          let now = 0;
          performance.now = () => now;
          const found = [];
          const look = (previous, gap, time, drawing) => {
            Object.assign(here.live, { frame: 9, previous, at: 1000, gap });
            here.times.here = drawing;
            now = time;
            found.push(here.liveMoment());
          };
          look(8, 100, 1025, 0);
          look(8, 100, 1025, 50);  // the picture will be finished 75 ms after the arrival
          look(8, 100, 1100, 0);
          look(8, 5000, 1100, 0);  // not slower than 200 ms
          look(null, 100, 1025, 0);  // a first state
          return found;
        }"""
    )
    assert moments == [
        {"index": 8, "next": 9, "share": 0.25},
        {"index": 8, "next": 9, "share": 0.75},
        {"index": 9, "next": None, "share": 0},
        {"index": 8, "next": 9, "share": 0.5},
        {"index": 9, "next": None, "share": 0},
    ]


def test_where_chunks_do_not_come_the_service_draws(page, service, finished):
    page.route("**/states.s4d*", lambda route: route.abort())
    opened(page, service, finished, 2)
    shown(page, drawn="service")
    turn(page, 3)
    page.wait_for_timeout(600)
    expect(page.locator("#view")).to_have_attribute("data-drawn", "service")
    page.select_option("#who", "here")
    until(page, "document.getElementById('note').innerText.includes('cannot be drawn here')")
    tag = page.locator("#view").get_attribute("data-tag")
    turn(page, 1)
    until(page, f"document.getElementById('view').dataset.tag !== '{tag}'")
    expect(page.locator("#curtain")).to_be_hidden()


def test_trails_and_parts_that_are_hidden_stay_at_rest(page, service, finished):
    opened(page, service, finished)
    shown(page, frame=str(FRAMES - 1), drawn="service")
    page.locator("#time").fill("5")
    shown(page, frame="5", drawn="service")
    page.click("#parts-box summary")
    page.get_by_label("Show part 1", exact=True).wait_for()
    page.get_by_label("Show part 2 alone").click()
    shown(page, frame="5", drawn="here")
    page.wait_for_timeout(500)
    expect(page.locator("#view")).to_have_attribute("data-drawn", "here")  # at rest, too
    expect(page.locator("#parts-words")).to_contain_text("3 of 4 hidden", use_inner_text=True)
    page.keyboard.press("Escape")
    page.get_by_label("Show part 2 alone").click()
    until(page, BY_THE_SERVICE)
    page.select_option("#trails", "200")
    until(page, HERE)
    first = seen(page)
    page.locator("#time").fill("1")
    shown(page, frame="1", drawn="here")
    page.wait_for_timeout(500)
    assert np.abs(seen(page) - first).mean() > 0.05
    page.select_option("#trails", "0")
    until(page, BY_THE_SERVICE)
    assert page.faults == []


def test_a_followed_point_moves_between_frames(page, service, finished):
    opened(page, service, finished, 0)
    shown(page, frame="0", drawn="service")
    picture = canvas(page)
    rows, columns = np.nonzero(picture[..., :3].sum(-1) > 150)
    pick = np.argsort(np.hypot(rows - rows.mean(), columns - columns.mean()))[0]
    box = page.locator("#overlay").bounding_box()
    right, down = (columns[pick] + 0.5) / picture.shape[1], (rows[pick] + 0.5) / picture.shape[0]
    page.mouse.click(box["x"] + right * box["width"], box["y"] + down * box["height"])
    until(page, "document.getElementById('tracks').innerText.includes('7 frames')")
    page.select_option("#who", "here")
    until(page, HERE)
    page.evaluate("""() => {
      const arc = CanvasRenderingContext2D.prototype.arc;
      window.dots = new Set();
      CanvasRenderingContext2D.prototype.arc = function (x, y, ...rest) {
        if (this.canvas.id === 'overlay') window.dots.add(`${x.toFixed(3)} ${y.toFixed(3)}`);
        return arc.call(this, x, y, ...rest);
      };
    }""")
    page.select_option("#speed", "0.1")
    page.click("#play")
    shown(page, frame="2")
    page.click("#play")
    assert page.evaluate("window.dots.size") > 4  # more than the frames 0 to 2 have
    assert page.faults == []


def test_what_fails_beside_costs_no_picture_and_parts_are_asked_for_again(page, service):
    page.goto(service.url)
    found = page.evaluate(
        """async () => {
          const { Here } = await import('/viewer/view/here.js');
          const here = new Here(document.createElement('canvas'), { drawn() {}, arrived() {}, parts() {} });
          const after = [];
          for (const during of ['ahead', 'file']) {
            here.withParts = true;
            here.failed({ during, words: 'damaged' });
            after.push([here.draws('colour'), here.withParts]);
          }
          return after;
        }"""
    )
    assert found == [[True, True], [False, False]]


def test_where_the_page_is_slow_and_the_service_is_not_the_service_draws(page, service):
    page.goto(service.url)
    chosen = page.evaluate(
        """async () => {
          const { Here } = await import('/viewer/view/here.js');
          const found = {};
          for (const [name, mine, theirs] of [['slow', 600, 80], ['both', 600, 500], ['fast', 60, 20]]) {
            const here = new Here(document.createElement('canvas'), { drawn() {}, arrived() {}, parts() {} });
            here.measure('service', theirs);
            const message = { asked: { moving: true, pace: 1 }, milliseconds: mine, decoding: 0 };
            for (let i = 0; i < 8; i++) here.shown(message);
            found[name] = [here.draws('colour')];
            here.choose('here');
            found[name].push(here.draws('colour'), here.draws('parts'));
          }
          return found;
        }"""
    )
    assert chosen == {"slow": [False, True, False], "both": [True, True, False], "fast": [True, True, False]}
    assert page.faults == []
