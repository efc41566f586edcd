"""The OpenAPI document fuzzed by schemathesis, over a real socket: no 500, every answer in the schema.

Bounded, and the same in every run. The service has a token, so that the check for authentication has something to
check; most requests that name a scene name one that is there, so that they reach what lies behind the door.
"""

from __future__ import annotations

import re
import warnings
import zlib

import pytest
from hypothesis import HealthCheck, assume, settings
from running import Running, fake_settings, make_rig, pictures
from waiting import HANG_S

from client.sdk import Client
from server.app import create_app

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # of its dependencies
    import schemathesis
    from schemathesis.checks import load_all_checks
    from schemathesis.specs.openapi.checks import positive_data_acceptance

load_all_checks()

EXAMPLES = 15
LONGEST = 5_000
"""Characters of path and query; a header may have 64 kB, and one character can take 12."""
TOKEN = "a-token-for-the-fuzzer-alone"
HEADERS = {"Authorization": f"Bearer {TOKEN}"}

document = create_app(fake_settings("unused", token=TOKEN)).openapi()
schema = schemathesis.openapi.from_dict(document)
known = {"id": "none"}


def test_the_document_has_every_resource():
    paths = document["paths"]
    assert {"/v1/scenes", "/v1/scenes/{id}/frames/{n}", "/v1/scenes/{id}/render", "/v1/tickets", "/metrics"} <= set(
        paths
    )
    assert document["security"] == [{"bearer": []}]
    assert "security" not in create_app(fake_settings("unused")).openapi()
    assert paths["/v1/scenes"]["get"]["summary"] == "Lists all scenes without waking them"
    for path, operations in paths.items():
        for method, operation in operations.items():
            assert operation["summary"], (method, path)
            assert "4XX" in operation["responses"], (method, path)


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory):
    """A service with a scene of two committed frames and one that has not begun."""
    running = Running(fake_settings(tmp_path_factory.mktemp("fuzzed"), token=TOKEN, max_scenes=3))
    with Client(running.url, token=TOKEN) as sdk:
        known["id"] = sdk.create_scene(make_rig()).id
        for index in range(2):
            sdk.put_frame(known["id"], index, pictures())
        sdk.wait(known["id"], 1)
        known["empty"] = sdk.create_scene(make_rig()).id
    yield running
    running.stop()


@schemathesis.serializer("application/vnd.numpy.npz", "application/vnd.scas4d.frame")
def as_bytes(context, value):
    """Bodies that the document calls binary, and what is sent in their place."""
    return value if isinstance(value, bytes) else repr(value).encode()


def aim(case):
    """Points at scenes and frames that exist, but for what would delete them and what cannot be an id."""
    given = case.path_parameters
    if not given or case.method == "DELETE" or not re.fullmatch("[0-9A-Za-z]{1,64}", str(given.get("id"))):
        return
    chance = zlib.crc32(repr((sorted(given.items()), case.body, case.query)).encode()) % 8
    if chance < 7:
        given["id"] = known["empty" if chance == 6 else "id"]
    if isinstance(given.get("n"), int) and given["n"] >= 0 and chance < 4:
        given["n"] %= 4


@schema.parametrize()
@settings(
    max_examples=EXAMPLES, derandomize=True, deadline=None, database=None, suppress_health_check=list(HealthCheck)
)
def test_no_answer_outside_the_document(case, fuzzed):
    aim(case)
    assume(len(repr((case.path_parameters, case.query))) < LONGEST)  # longer: 414, which the checks do not expect
    case.call_and_validate(
        base_url=fuzzed.url,
        headers=HEADERS,
        # That a rotation is one, or that a picture is whole, cannot be said in a schema: 422 is right there.
        excluded_checks=[positive_data_acceptance],
        timeout=HANG_S,
    )


def test_it_still_works_afterwards(fuzzed):
    with Client(fuzzed.url, token=TOKEN) as sdk:
        assert sdk.scene(known["id"]).committed >= 2
        assert sdk.render(known["id"], "c0").size
        sdk.edit_scene(known["id"], archived=False)  # requests that were made up may have archived it
        sdk.put_frame(known["id"], sdk.scene(known["id"]).next_frame, pictures(3))
