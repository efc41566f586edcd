"""Services of a cluster find one another by Ray's named actors; Ray is a fake here."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

pytest.importorskip("ray", reason="Ray is not installed: pip install 'scas4d[ray]'")

from server.cluster import nodes, service_registry
from server.cluster.service_registry import peer_addresses, register_service

HERE = "10.0.0.2"


class Cluster:
    """Named actors as a Ray of one machine knows them: each name with what its actor tells."""

    def __init__(self) -> None:
        self.told: dict[str, tuple[str, str | None]] = {}
        self.node = "a"
        self.util = SimpleNamespace(get_node_ip_address=lambda: HERE, list_named_actors=lambda: list(self.told))

    def remote(self, kind):
        def options(name, **rest):
            def make(*arguments):
                self.told[name] = kind(*arguments).get()

            return SimpleNamespace(remote=make)

        return SimpleNamespace(options=options)

    def get_runtime_context(self):
        return SimpleNamespace(get_node_id=lambda: self.node)

    def get_actor(self, name):
        return SimpleNamespace(get=SimpleNamespace(remote=lambda: name))

    def wait(self, asked, num_returns, timeout):
        return asked, []

    def get(self, name):
        return self.told[name]


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Cluster:
    cluster = Cluster()
    monkeypatch.setattr(nodes, "ray", cluster)
    monkeypatch.setattr(service_registry, "ray", cluster)
    monkeypatch.setattr(service_registry, "NodeAffinitySchedulingStrategy", lambda node, soft: None)
    return cluster


def test_services_of_one_machine_find_one_another_whichever_of_its_nodes_they_are_members_by(cluster: Cluster) -> None:
    """Ray takes any node of a machine once the head's is lost; each service may take another."""
    register_service("one", "127.0.0.1", 8001)
    cluster.node = "b"
    register_service("two", "127.0.0.1", 8002)
    assert peer_addresses("two", None) == {"service.one": "http://127.0.0.1:8001"}
    cluster.node = "a"
    assert peer_addresses("one", None) == {"service.two": "http://127.0.0.1:8002"}


def test_a_service_at_a_loopback_address_is_no_sibling_on_another_machine(cluster: Cluster) -> None:
    cluster.told = {
        "service.far": ("http://127.0.0.1:8001", "10.0.0.3"),
        "service.open": ("http://10.0.0.3:8001", None),
        "actor": ("", None),
    }
    assert peer_addresses("me", None) == {"service.open": "http://10.0.0.3:8001"}


def test_an_address_that_stands_for_all_is_told_as_that_of_the_machine(cluster: Cluster) -> None:
    register_service("one", "0.0.0.0", 8000)
    assert peer_addresses("two", None) == {"service.one": f"http://{HERE}:8000"}


def test_a_service_that_is_known_is_not_asked_again(cluster: Cluster) -> None:
    cluster.told = {"service.one": ("http://10.0.0.3:1", None)}
    assert peer_addresses("me", {"service.one": "http://10.0.0.3:2", "service.gone": "http://10.0.0.4:1"}) == {
        "service.one": "http://10.0.0.3:2"
    }
