"""/metrics, logs and readiness: what those who run the service look at."""

from __future__ import annotations

import json
import logging
import sys
import time

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families
from running import Running, fake_settings, make_rig, pictures, problem
from waiting import HANG_S

from client.sdk import Client
from server.health import logs


def samples(http):
    found = {}
    for family in text_string_to_metric_families(http.get("/metrics").text):
        for sample in family.samples:
            found[sample.name, *sorted(sample.labels.values())] = sample.value
    return found


def test_what_happens_to_frames_and_questions_is_counted(http, sdk, scene):
    before = samples(http)
    for index in range(2):
        sdk.put_frame(scene, index, pictures())
    sdk.wait(scene, 1)
    sdk.render(scene, "c0")
    after = samples(http)

    def risen(*key):
        return after[key] - before.get(key, 0)

    assert risen("scas4d_frames_total", "acknowledged") == 2
    assert risen("scas4d_frames_total", "committed") == 2
    assert risen("scas4d_frames_total", "failed") == 0
    sent = sum(map(len, pictures().values()))
    assert 2 * sent <= risen("scas4d_ingest_bytes_total") <= 2 * sent + 4096
    assert risen("scas4d_update_seconds_count", "update") == 2
    assert risen("scas4d_query_seconds_count", "answered", "render") == 1
    assert after["scas4d_queue_frames", scene] == 0
    assert after["scas4d_committed_frames", scene] == 2
    assert after["scas4d_subscribers",] == 0
    assert after["scas4d_disk_free_bytes",] > 0
    assert after["scas4d_scenes", "ready"] >= 1
    assert http.get("/metrics").headers["content-type"].startswith("text/plain")


def record(message, **extra):
    given = {"msg": message, "levelname": "INFO", "levelno": logging.INFO, "name": "scas4d.x"}
    return logging.makeLogRecord({**given, **extra})


def test_a_log_line_is_one_json_object_without_secrets():
    line = logs.JsonFormatter().format(
        record('say "hi"\nAuthorization: Bearer abc.def-123 scas4d.ticket.xyz9', scene="s")
    )
    assert "\n" not in line
    entry = json.loads(line)
    assert (entry["level"], entry["logger"], entry["scene"]) == ("info", "scas4d.x", "s")
    assert "abc" not in line
    assert "xyz9" not in line
    assert "T" in entry["time"]
    plain = logs.TextFormatter().format(record("?token=abcdef&x=1"))
    assert "abcdef" not in plain


def test_a_plain_log_line_escapes_control_characters():
    line = logs.TextFormatter().format(record("scene \x1b[31m\nfake: \u202eline"))
    assert line.endswith("scene \\x1b[31m\\nfake: \\u202eline")


def test_an_exception_is_logged_with_its_traceback():
    try:
        raise KeyError("where")
    except KeyError:
        entry = json.loads(logs.JsonFormatter().format(record("failed", exc_info=sys.exc_info())))
    assert "KeyError: 'where'" in entry["exception"]


def test_requests_are_logged_without_query_and_headers(http, caplog):
    with caplog.at_level(logging.INFO, "scas4d.access"):
        http.get("/v1/scenes/a%0Ab?camera=secret", headers={"Authorization": "Bearer never-to-be-seen-here"})
        http.get("/health/live")
    line, live = caplog.records[-2:]
    assert line.path == "/v1/scenes/a%0Ab"
    assert (line.method, line.status, live.status) == ("GET", 400, 200)  # no address holds a line break
    assert live.bytes_out > 0
    assert "secret" not in caplog.text
    assert "never" not in caplog.text


def waited(running):
    """The first answer that is not 'not yet'."""
    while True:
        answer = httpx.get(f"{running.url}/health/ready", timeout=HANG_S)
        if answer.status_code == 200 or "seconds" not in answer.json() or "retry-after" not in answer.headers:
            return answer
        time.sleep(0.05)


def test_ready_says_how_long_the_kernels_took(tmp_path, monkeypatch):
    until = tmp_path / "compiled"
    monkeypatch.setenv("FAKE_WARM_UP_UNTIL", str(until))
    running = Running(fake_settings(tmp_path, warm_up=True))
    try:
        assert httpx.get(f"{running.url}/health/live", timeout=HANG_S).json()["status"] == "live"
        early = httpx.get(f"{running.url}/health/ready", timeout=HANG_S)
        assert "have been loading" in problem(early, 503)["detail"]
        assert early.headers["retry-after"] == "1"
        while "kernels" not in early.json():  # until the process beside has told how far it is
            early = httpx.get(f"{running.url}/health/ready", timeout=HANG_S)
        assert (early.json()["kernels_compiled"], early.json()["kernels"]) == (1, 3)
        assert early.json()["detail"].endswith("on the first start (1 of 3 done)")
        until.touch()
        answer = waited(running)
        assert answer.json()["ready_after"] > 0
        with httpx.Client(base_url=running.url, timeout=HANG_S) as http:
            assert samples(http)["scas4d_ready_after_seconds",] > 0
    finally:
        running.stop()


def test_kernels_that_cannot_be_warmed_up_are_reported(tmp_path, monkeypatch):
    monkeypatch.setenv("FAKE_FAULT", "1")
    running = Running(fake_settings(tmp_path, warm_up=True))
    try:
        answer = waited(running)
        assert "told to raise" in problem(answer, 503)["detail"]
        with Client(running.url) as sdk:  # it works without, and says so with its first frame if it does not
            assert sdk.create_scene(make_rig()).state == "awaiting_first_frame"
    finally:
        running.stop()


@pytest.mark.parametrize("path", ["/health/live", "/health/ready"])
def test_health_without_waiting(http, path):
    document = http.get(path).json()
    assert (document["version"], document["status"]) == ("0.1.0", path.rpartition("/")[2])
