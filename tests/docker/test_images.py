"""The images: they run as a user without rights, from pinned bases, with locked packages, and hold nothing else."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
DOCKER = ROOT / "docker"
DOCKERFILES = sorted(DOCKER.glob("*.Dockerfile"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
DIGEST = re.compile(r"@sha256:[0-9a-f]{64}$")
PIN = re.compile(r"^([\w.-]+)==(\S+) \\\n((?:    --hash=sha256:[0-9a-f]{64}(?: \\)?\n)*)", re.M)


def instructions(text: str) -> list[tuple[str, str]]:
    """Instructions of a Dockerfile with their arguments, continued lines joined."""
    lines = "\n".join(line for line in text.splitlines() if not line.startswith("#"))
    joined = re.sub(r"\\\n\s*", "", lines)
    return [(line.split(None, 1)[0], line.split(None, 1)[1]) for line in joined.splitlines() if line.strip()]


def final_stage(text: str) -> list[tuple[str, str]]:
    found = instructions(text)
    last = max(i for i, (name, _) in enumerate(found) if name == "FROM")
    return found[last:]


def pins(text: str) -> dict[str, tuple[str, int]]:
    """Version and number of hashes of every package of a lock file."""
    return {canonicalize_name(name): (version, hashes.count("sha256:")) for name, version, hashes in PIN.findall(text)}


def missing(requirements: list[str], locked: dict[str, tuple[str, int]]) -> list[str]:
    """Requirements that the lock file does not meet, on Linux with the oldest Python."""
    found = []
    for text in requirements:
        wanted = Requirement(text)
        version = locked.get(canonicalize_name(wanted.name), (None, 0))[0]
        if version is None or not wanted.specifier.contains(version, prereleases=True):
            found.append(text)
    return found


def test_the_dockerfiles_were_found() -> None:
    assert [path.name for path in DOCKERFILES] == ["cpu.Dockerfile"]


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)
def test_the_user_is_a_number_and_not_root(path: Path) -> None:
    users = [value for name, value in final_stage(path.read_text()) if name == "USER"]
    assert len(users) == 1
    assert re.fullmatch(r"[1-9]\d+:[1-9]\d+", users[0])


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)
def test_bases_are_pinned_by_digest(path: Path) -> None:
    found = instructions(path.read_text())
    arguments = dict(value.split("=", 1) for name, value in found if name == "ARG")
    stages = {value.split(" AS ")[1] for name, value in found if name == "FROM" and " AS " in value}
    for name, value in found:
        if name == "FROM":
            base = value.split(" AS ")[0]
            base = arguments.get(base.strip("${}"), base)
            assert base in stages or DIGEST.search(base), f"{path.name}: {base} has no digest"


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)
def test_the_last_stage_takes_only_the_environment(path: Path) -> None:
    copied = [value for name, value in final_stage(path.read_text()) if name in ("COPY", "ADD")]
    assert copied == ["--from=build /opt/scas4d /opt/scas4d"]
    assert not [value for name, value in final_stage(path.read_text()) if name == "RUN" and "pip" in value]


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)
def test_they_are_made_of_files_that_are_here(path: Path) -> None:
    ignored = path.with_name(path.name + ".dockerignore").read_text().splitlines()
    assert "*" in ignored  # nothing is sent but what is named
    named = {line[1:] for line in ignored if line.startswith("!")}
    for name, value in instructions(path.read_text()):
        if name == "COPY" and not value.startswith("--from"):
            for source in value.split()[:-1]:
                assert (ROOT / source).exists(), f"{path.name} copies {source}: there is no such file"
                assert {source, "docker/*.lock"} & named, f"{path.name}: {source} is ignored"


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)
def test_health_is_asked_without_further_programs(path: Path) -> None:
    (check,) = [value for name, value in instructions(path.read_text()) if name == "HEALTHCHECK"]
    assert '"python", "-c"' in check
    assert "/health/live" in check


@pytest.mark.parametrize(("file", "extra"), [("requirements.lock", "server"), ("requirements-gpu.lock", "gpu")])
def test_locked_packages_have_hashes_and_meet_the_requirements(file: str, extra: str) -> None:
    locked = pins((DOCKER / file).read_text())
    assert len(locked) > 30  # the file was read
    assert [name for name, (_, hashes) in locked.items() if hashes == 0] == []
    project = PROJECT["project"]
    extras = project["optional-dependencies"]
    wanted = [*project["dependencies"], *extras["server"], *extras[extra]]
    wanted = [each for each in wanted if not each.startswith("scas4d[")]
    assert missing(wanted, locked) == [], "run scripts/lock"
    assert ("warp-lang" in locked) == (extra == "gpu")
    assert "torch" not in locked  # gigabytes that the CPU does not use
    tools = [*PROJECT["build-system"]["requires"], *extras["site"]]
    assert missing(tools, pins((DOCKER / "build.lock").read_text())) == []


def test_a_lock_that_has_fallen_behind_is_found() -> None:
    locked = pins("numpy==1.26.0 \\\n    --hash=sha256:" + "0" * 64 + "\n    # via scas4d\n")
    assert locked == {"numpy": ("1.26.0", 1)}
    assert missing(["numpy>=2.0", "numpy>=1.20", "pillow"], locked) == ["numpy>=2.0", "pillow"]


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)
def test_packages_are_installed_from_the_lock(path: Path) -> None:
    text = " ".join(value for name, value in instructions(path.read_text()) if name == "RUN")
    assert "--require-hashes --only-binary :all: -r ${LOCK}" in text
    locks = [value for name, value in instructions(path.read_text()) if name == "ARG" and value.startswith("LOCK=")]
    assert locks == ["LOCK=requirements.lock"]
    assert "--require-hashes --only-binary :all: -r build.lock" in text
    installs = re.findall(r"pip install ([^&]*)", text)
    unpinned = [line for line in installs if not re.search(r"--require-hashes|--no-index|==\d", line)]
    assert unpinned == []
