"""The compose file: every container has as few rights as it can do with."""

from __future__ import annotations

import copy
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

DOCKER = Path(__file__).parents[2] / "docker"
COMPOSE = yaml.safe_load((DOCKER / "compose.yaml").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]


def faults(service: dict[str, Any]) -> list[str]:
    """Rights that a container has without need."""
    checks = {
        "its root can be written": service.get("read_only") is True,
        "it keeps capabilities": service.get("cap_drop") == ["ALL"] and "cap_add" not in service,
        "it may gain privileges": "no-new-privileges:true" in service.get("security_opt", ()),
        "it runs as root": re.match(r"[1-9]\d*:", service.get("user", "0")) is not None,
        "its memory has no limit": bool(service.get("mem_limit")),
        "its processes have no limit": service.get("pids_limit", 0) > 0,
        "its /tmp has no limit": any(mount.startswith("/tmp:size=") for mount in service.get("tmpfs", ())),
        "it is open to the network": all(port.startswith("127.0.0.1:") for port in service.get("ports", ())),
        "its image is not pinned": "build" in service or "@sha256:" in service["image"],
        "it is privileged": not service.get("privileged") and "network_mode" not in service,
        "it may write into the repository": all(
            not mount.startswith(".") or mount.endswith(":ro") for mount in service.get("volumes", ())
        ),
        "a secret is in its environment": not any(
            re.search("TOKEN$|PASSWORD$", name) for name in service.get("environment", {})
        ),
    }
    return [fault for fault, well in checks.items() if not well]


@pytest.mark.parametrize("name", SERVICES)
def test_services_have_few_rights(name: str) -> None:
    assert faults(SERVICES[name]) == []


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"read_only": False}, "its root can be written"),
        ({"cap_drop": []}, "it keeps capabilities"),
        ({"user": "0:0"}, "it runs as root"),
        ({"mem_limit": None}, "its memory has no limit"),
        ({"ports": ["8000:8000"]}, "it is open to the network"),
        ({"environment": {"SCAS4D_TOKEN": "x"}}, "a secret is in its environment"),
    ],
)
def test_a_right_too_many_is_found(change: dict[str, Any], fault: str) -> None:
    assert faults({**copy.deepcopy(SERVICES["scas4d"]), **change}) == [fault]


def test_volumes_secrets_and_mounted_files_are_there() -> None:
    for name, service in SERVICES.items():
        assert set(service.get("secrets", ())) <= set(COMPOSE["secrets"]), name
        for mount in service.get("volumes", ()):
            source = mount.split(":")[0]
            assert (DOCKER / source).exists() if source.startswith(".") else source in COMPOSE["volumes"], name
        if "build" in service:
            assert (DOCKER.parent / service["build"]["dockerfile"]).is_file()


def test_the_gpu_file_only_adds_the_lock_and_the_gpu() -> None:
    added = yaml.safe_load((DOCKER / "compose.gpu.yaml").read_text())
    (name,) = added["services"]
    service = added["services"][name]
    assert name == "scas4d"
    assert set(service) == {"image", "build", "deploy"}
    assert (DOCKER / service["build"]["args"]["LOCK"]).is_file()
    (device,) = service["deploy"]["resources"]["reservations"]["devices"]
    assert device == {"driver": "nvidia", "count": 1, "capabilities": ["gpu"]}


def test_the_user_is_that_of_the_image() -> None:
    service = SERVICES["scas4d"]
    dockerfile = (DOCKER.parent / service["build"]["dockerfile"]).read_text()
    assert f"\nUSER {service['user']}\n" in dockerfile
    assert f"-o {service['user'].split(':')[0]} " in dockerfile  # owns its volumes


def test_prometheus_may_read_the_metrics() -> None:
    (job,) = yaml.safe_load((DOCKER / "prometheus" / "prometheus.yml").read_text())["scrape_configs"]
    (target,) = job["static_configs"][0]["targets"]
    host, _, port = target.partition(":")
    assert host in SERVICES
    environment = SERVICES[host]["environment"]
    assert host in environment["SCAS4D_ALLOWED_HOSTS"].split(",")
    assert SERVICES[host]["ports"] == [f"127.0.0.1:{port}:{port}"]
    assert job["authorization"]["credentials_file"] == "/run/secrets/read_token"
    assert SERVICES["prometheus"]["secrets"] == ["read_token"]  # it may read, and change nothing
    assert environment["SCAS4D_TOKEN_FILE"] == "/run/secrets/token"


def test_the_image_is_tried_with_the_limits_of_the_compose_file() -> None:
    script, service = (DOCKER / "try-image").read_text(), SERVICES["scas4d"]
    memory = re.search(r":-(\w+)", service["mem_limit"])
    assert memory is not None
    for option in (
        "--read-only ",
        "--cap-drop all",
        "--security-opt no-new-privileges",
        f"--tmpfs {service['tmpfs'][0]}",
        f"--memory {memory[1]}",
        f"--pids-limit {service['pids_limit']}",
    ):
        assert option in script
