"""Retries: what is sent again, what never, and that the limits hold."""

from __future__ import annotations

import asyncio
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime
from types import SimpleNamespace

import httpx
import pytest
from running import make_rig

from client import errors
from client.calls import frame, put_frame
from client.retries import Retries, retry_after_seconds
from client.sdk import AsyncClient, Client

OK = {"scene": "s", "index": 0, "time": 0.0, "identity": "i"}


def problem(status, headers=None, **more):
    document = {"title": "t", "status": status, "detail": f"said {status}", **more}
    return httpx.Response(status, headers=headers, json=document)


class Script:
    """Answers as it is told, then with 200."""

    def __init__(self, *answers):
        self.answers = list(answers)
        self.requests = []

    def __call__(self, request):
        self.requests.append((request.method, request.url.path))
        answer = self.answers.pop(0) if self.answers else httpx.Response(200, json=OK)
        if isinstance(answer, Exception):
            raise answer
        return answer


def scripted(*answers, **options):
    script = Script(*answers)
    return Client("http://nowhere", transport=httpx.MockTransport(script), **options), script


def busy(seconds="0"):
    return problem(429, {"Retry-After": seconds})


def test_a_frame_is_sent_again_after_broken_connections_full_queues_and_a_proxy_without_a_service():
    heard = []
    client, script = scripted(
        httpx.ReadError("cut"), busy(), httpx.ConnectError("down"), problem(502), busy(), on_retry=heard.append
    )
    assert client.put_frame("s", 0, {"c": b"x"}).identity == "i"
    assert script.requests == [("PUT", "/v1/scenes/s/frames/0")] * 6
    assert [retry.reason for retry in heard] == ["outage", "busy", "outage", "outage", "busy"]
    assert heard[1].detail == "said 429"


def test_the_async_client_does_the_same():
    async def job():
        script = Script(httpx.ReadError("cut"), busy(), problem(503))
        async with AsyncClient("http://nowhere", transport=httpx.MockTransport(script)) as client:
            await client.put_frame("s", 0, {"c": b"x"})
            return script.requests

    assert len(asyncio.run(job())) == 4


@pytest.mark.parametrize("status", [400, 401, 403, 404, 409, 413, 415, 422, 500])
def test_what_would_be_refused_again_is_sent_once(status):
    client, script = scripted(problem(status))
    with pytest.raises(errors.ServiceError, match=f"said {status}") as caught:
        client.put_frame("s", 0, {"c": b"x"})
    assert len(script.requests) == 1
    assert caught.value.status == status


def test_making_a_scene_is_sent_again_only_where_nothing_was_sent():
    for fault in (httpx.ReadError("cut"), httpx.ReadTimeout("slow")):
        client, script = scripted(fault)
        with pytest.raises(errors.ServiceUnreachable, match="nowhere"):
            client.create_scene(make_rig())
        assert len(script.requests) == 1
    for answer in (problem(503), problem(429, {"Retry-After": "0"})):
        client, script = scripted(answer)
        with pytest.raises(errors.ServiceError):
            client.create_scene(make_rig())
        assert len(script.requests) == 1
    client, script = scripted(httpx.ConnectError("down"), problem(422))
    with pytest.raises(errors.InvalidRequest):
        client.create_scene(make_rig())
    assert len(script.requests) == 2


@pytest.fixture
def clock(monkeypatch):
    """Waits of the client take no time, and its clock goes on by them."""
    now = [0.0]

    def wait(seconds):
        now[0] += seconds

    for module in ("client.sdk", "client.retries"):
        monkeypatch.setattr(f"{module}.time", SimpleNamespace(monotonic=lambda: now[0], sleep=wait))
    return now


def test_patience_with_a_full_queue_ends(clock):
    client, script = scripted(*[busy()] * 99, busy_timeout=0.35)
    with pytest.raises(errors.Busy, match="said 429"):
        client.put_frame("s", 0, {"c": b"x"})
    assert 2 < len(script.requests) < 10
    client, script = scripted(busy("60"), busy("60"), busy_timeout=0.1)  # asks for more than there is: one last try
    with pytest.raises(errors.Busy):
        client.put_frame("s", 0, {"c": b"x"})
    assert len(script.requests) == 2


@pytest.mark.parametrize(
    ("answer", "least", "most"),
    [
        (problem(429, {"Retry-After": "60"}, retry_after_seconds=0.3), 0.3, 0.33),  # the exact one counts
        (problem(429, {"Retry-After": "60"}, retry_after_seconds=12.0), 6.0, 6.6),  # long ones are asked about again
        (problem(429, {"Retry-After": "60"}, retry_after_seconds=3.0), 2.0, 2.2),
        (problem(429, {"Retry-After": "60"}, retry_after_seconds=500.0), 10.0, 11.0),
        (problem(429, {"Retry-After": "60"}, retry_after_seconds="soon"), 60.0, 66.0),
        (problem(429, {"Retry-After": "60"}), 60.0, 66.0),  # no prediction: it is waited for whole
        (problem(429), 1.0, 1.1),
    ],
)
def test_a_predicted_wait_is_exact_and_a_long_one_is_asked_about_again(answer, least, most):
    retries = Retries(put_frame("s", 0, {"c": b"x"}), "http://nowhere", busy=1e6, outage=1)
    assert least <= retries.after_response(answer) <= most


def test_an_outage_is_waited_for_until_its_limit_and_no_longer(clock):
    client, script = scripted(*[httpx.ConnectError("down")] * 99, outage=0.5)
    with pytest.raises(errors.ServiceUnreachable, match=r"http://nowhere cannot be reached after \d attempts: down"):
        client.frame("s", 0)
    assert 2 < len(script.requests) < 10
    client, script = scripted(httpx.ConnectError("down"), outage=0)
    with pytest.raises(errors.ServiceUnreachable):
        client.frame("s", 0)
    assert len(script.requests) == 1


def test_waits_grow_to_a_limit_and_are_not_all_alike(clock):
    runs = []
    for _ in range(20):
        retries = Retries(frame("s", 0), "u", busy=0, outage=1e9)
        waits = []
        for _ in range(12):
            waits.append(retries.after_connection_error(httpx.ReadError("cut")))
            clock[0] += waits[-1]
        runs.append(waits)
        expected = [min(0.2 * 2**n, 5.0) for n in range(12)]
        assert all(0.5 * top <= wait <= top for wait, top in zip(waits, expected, strict=True))
    assert len({waits[3] for waits in runs}) > 10


def test_a_full_queue_says_that_the_service_is_back(clock):
    """An outage is counted from its own first failure, not from that of one long over."""
    retries = Retries(put_frame("s", 0, {"c": b"x"}), "u", busy=10, outage=0.2)
    retries.after_connection_error(httpx.ReadError("cut"))
    clock[0] += 0.25
    assert retries.after_response(busy()) is not None
    assert retries.after_connection_error(httpx.ReadError("cut")) <= 0.2


def test_a_delete_that_was_lost_on_the_way_back_is_done():
    client, _ = scripted(httpx.ReadError("cut"), problem(404))
    client.delete_scene("s")
    client, _ = scripted(problem(404))
    with pytest.raises(errors.NotFound):
        client.delete_scene("s")
    client, _ = scripted(httpx.ConnectError("down"), problem(404))  # nothing was lost: it never was there
    with pytest.raises(errors.NotFound):
        client.delete_scene("s")


def test_retry_after_is_seconds_or_a_date():
    assert retry_after_seconds("7") == 7
    later = format_datetime(datetime.now(UTC) + timedelta(seconds=30), usegmt=True)
    assert 25 < retry_after_seconds(later) <= 30
    assert retry_after_seconds(format_datetime(datetime.now(UTC) - timedelta(days=1), usegmt=True)) == 0
    assert retry_after_seconds("soon") is None
    assert retry_after_seconds("") is None


@pytest.mark.parametrize(
    ("status", "kind"),
    [
        (401, errors.NotAuthorized),
        (404, errors.NotFound),
        (409, errors.Conflict),
        (413, errors.TooLarge),
        (418, errors.ServiceError),
        (422, errors.InvalidRequest),
        (504, errors.ServiceFault),
    ],
)
def test_errors_have_types_and_carry_the_document(status, kind):
    client, _ = scripted(problem(status, field="n", remedy="do that", value="7"), outage=0)
    with pytest.raises(kind) as caught:
        client.frame("s", 0)
    assert type(caught.value) is kind
    assert (caught.value.problem.field, caught.value.problem.value) == ("n", "7")
    assert str(caught.value) == f"{status}: said {status} (do that)"


def test_a_gap_says_what_comes_next_and_other_content_is_no_gap():
    client, _ = scripted(problem(409, expected=3))
    with pytest.raises(errors.FrameGap) as gap:
        client.put_frame("s", 5, {"c": b"x"})
    assert gap.value.expected == 3
    client, _ = scripted(problem(409, expected=3, identity="other"))
    with pytest.raises(errors.Conflict) as other:
        client.put_frame("s", 1, {"c": b"x"})
    assert not isinstance(other.value, errors.FrameGap)


def test_an_answer_of_something_else_is_shown():
    client, _ = scripted(httpx.Response(502, text="<html>bad gateway"), outage=0)
    with pytest.raises(errors.ServiceFault, match="bad gateway"):
        client.scenes()


def test_the_token_goes_in_the_header_and_names_cannot_lead_elsewhere():
    seen = []

    def answer(request):
        seen.append(request)
        return httpx.Response(200, json=OK)

    with Client("http://nowhere", token="secret", transport=httpx.MockTransport(answer)) as client:
        client.put_frame("../../x", 0, {"c": b"x"})
    assert seen[0].headers["authorization"] == "Bearer secret"
    assert seen[0].url.raw_path == b"/v1/scenes/..%2F..%2Fx/frames/0"
