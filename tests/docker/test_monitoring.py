"""Alerts and the board ask for metrics that the service has, and every alert says what to do."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml
from prometheus_client import Metric

from client.wire import Cluster, Node
from server import counters
from server.health.metrics import ServiceState
from server.settings import ServerSettings

DOCKER = Path(__file__).parents[2] / "docker"
RULES = [
    rule
    for group in yaml.safe_load((DOCKER / "prometheus" / "alerts.yml").read_text())["groups"]
    for rule in group["rules"]
]
BOARD = json.loads((DOCKER / "grafana" / "boards" / "scas4d.json").read_text())
OTHERS = {"up", "ALERTS"}
"""Metrics that Prometheus makes itself."""
SUFFIXES = {"counter": ("_total",), "histogram": ("_bucket", "_sum", "_count"), "gauge": ("",)}
SELECTOR = re.compile(r"\b(scas4d_\w+|up|ALERTS)\b(?:\{([^}]*)\})?")
MATCHER = re.compile(r'(\w+)\s*(?:=~|!~|!=|=)\s*"([^"]*)"')


@pytest.fixture(scope="module")
def families(tmp_path_factory: pytest.TempPathFactory) -> list[Metric]:
    """All metrics of a service that is ready, and has had every outcome: other tests may have had some of them."""
    for outcome in ("answered", "failed", "cancelled"):  # `Readers.ask`
        counters.QUERY_SECONDS.labels("render", outcome)
    settings = ServerSettings(data=tmp_path_factory.mktemp("data"))
    room = {"cpus": 8, "cpus_reserved": 1, "gpus": 0, "memory_mb": 16_000, "memory_reserved_mb": 700}
    node = Node(id="n", host="h", alive=True, scenes=["s"], **room)
    cluster = Cluster(placement="ray", nodes=[node], waiting=[])
    state = ServiceState(settings, [], 0, 1.0, {"idle": 0}, cluster)
    return [*counters.registry.collect(), *state.collect()]


def exposed(families: list[Metric]) -> dict[str, Metric]:
    return {family.name + suffix: family for family in families for suffix in SUFFIXES[family.type]}


def unknown(expression: str, families: list[Metric]) -> list[str]:
    """Metrics of an expression, and values of their labels, that the service does not have."""
    known, found = exposed(families), []
    for name, matchers in SELECTOR.findall(expression):
        if name in OTHERS:
            continue
        if name not in known:
            found.append(name)
            continue
        for label, values in MATCHER.findall(matchers):
            have = {sample.labels[label] for sample in known[name].samples if label in sample.labels}
            found += [f"{name} {label}={value}" for value in values.split("|") if have and value not in have]
    return found


def board_expressions() -> dict[str, str]:
    return {
        f"{panel['title']} {target['refId']}": target["expr"]
        for panel in BOARD["panels"]
        for target in panel["targets"]
    }


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule["alert"])
def test_alerts_ask_for_what_there_is(rule: dict[str, str], families: list[Metric]) -> None:
    assert SELECTOR.search(rule["expr"])
    assert unknown(rule["expr"], families) == []


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule["alert"])
def test_alerts_say_what_to_do(rule: dict[str, dict[str, str]]) -> None:
    assert re.fullmatch(r"[1-9]\d*m", str(rule["for"]))
    assert rule["labels"]["severity"] in ("critical", "warning")
    assert rule["annotations"]["summary"].endswith(".")
    assert len(rule["annotations"]["description"].split()) > 12
    variables = re.findall(r"SCAS4D_(\w+)", rule["annotations"]["description"])
    assert {name.lower() for name in variables} <= set(ServerSettings.model_fields)


def test_alerts_have_names_of_their_own() -> None:
    names = [rule["alert"] for rule in RULES]
    assert len(names) == len(set(names)) > 10


def test_the_board_asks_for_what_there_is(families: list[Metric]) -> None:
    expressions = board_expressions()
    assert len(expressions) > 20
    assert {name: unknown(text, families) for name, text in expressions.items() if unknown(text, families)} == {}


def test_the_board_shows_every_metric(families: list[Metric]) -> None:
    shown = {name for text in board_expressions().values() for name, _ in SELECTOR.findall(text)}
    known = exposed(families)
    hidden = {family.name for family in families} - {known[name].name for name in shown if name in known}
    assert hidden == {"scas4d_ready_after_seconds"}  # a number of the start; an alert asks for it


def test_what_there_is_not_is_found(families: list[Metric]) -> None:
    assert unknown("rate(scas4d_frames[5m])", families) == ["scas4d_frames"]  # counters end in _total
    assert unknown('scas4d_frames_total{state=~"committed|lost"}', families) == ["scas4d_frames_total state=lost"]
    assert unknown('up == 0 or scas4d_subscribers{scene="s"} > 1', families) == []


def test_the_board_asks_the_source_that_is_set_up() -> None:
    folder = DOCKER / "grafana" / "provisioning"
    (source,) = yaml.safe_load((folder / "datasources" / "prometheus.yml").read_text())["datasources"]
    assert {panel["datasource"]["uid"] for panel in BOARD["panels"]} == {source["uid"]}
    (provider,) = yaml.safe_load((folder / "dashboards" / "boards.yml").read_text())["providers"]
    assert provider["options"]["path"] == "/etc/grafana/boards"
    services = yaml.safe_load((DOCKER / "compose.yaml").read_text())["services"]
    assert "./grafana/boards:/etc/grafana/boards:ro" in services["grafana"]["volumes"]


def test_prometheus_fires_the_alerts() -> None:
    promtool = shutil.which("promtool")
    if promtool is None:
        pytest.skip("promtool is not on the path")
    done = subprocess.run(
        [promtool, "test", "rules", "alerts_test.yml"], cwd=DOCKER / "prometheus", capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
