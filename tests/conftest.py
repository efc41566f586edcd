"""Tests get their marks; kernels are compiled once for all processes; the longest come first; failures are named."""

import os
import sys

import pytest

import scas4d_core  # noqa: F401  # sets how OpenMP threads wait, before torch loads OpenMP

WITHOUT_KERNELS = (
    "tests/core/captures", "tests/client/importers", "tests/core/metrics", "tests/docker", "tests/server/connections",
    "tests/core/engines/torch",
    "tests/test_docs.py", "tests/test_imports.py", "tests/test_wheel.py",
)  # fmt: skip
"""Tests that run no kernel, in no process: they go on while another process compiles."""
LONGEST = (
    "test_ray_placement.py",
    "test_hard_cases.py",
    "test_faults.py",
    "test_damage.py",
    "test_reproducible.py",
    "test_operations.py",
    "test_client_demo.py",
    "test_soak.py",
    "test_gradients.py",
    "test_frame_cases.py",
    "test_light.py",
)
"""Files that take longest: begun last, they would have the other processes wait for them."""


@pytest.fixture(autouse=True)
def kernels(request: pytest.FixtureRequest) -> None:
    """Kernels are compiled once, in a process beside: of the tests' processes one asks for it, the others wait."""
    if not path_of(request.node).startswith(WITHOUT_KERNELS):
        from scas4d_core.warm_up import compile_in_processes

        compile_in_processes()


@pytest.hookimpl(tryfirst=True)  # before fixtures run kernels
def pytest_runtest_setup() -> None:
    """If several processes run tests, the main thread of each runs kernels and torch on one thread.

    Threads that wait for each other on busy cores take longer: 1.4 times on two cores (2026-11-30). Processes that
    tests start, and tests of the number of threads, use more.
    """
    if int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")) > 1:
        for name in ("numba", "torch"):
            if name in sys.modules:
                sys.modules[name].set_num_threads(1)


SERVICE_FIXTURES = {"service", "app"}
SERVICE_STARTERS = {"Running", "Service", "serving", "serving_with", "stub"}
"""A test that has one of those fixtures, or whose file imports one of those helpers, gets the mark `service`."""
SLOW = "tests/studies/"
BROWSER = "tests/browser/"
SECOND_PROCESSOR = ("tests/core/kernels/", "tests/core/properties/")
"""The same folders are named in .ci/run. Engines run these kernels; `test_reproducible` covers a whole scene."""


def path_of(item: pytest.Item) -> str:
    return item.path.relative_to(item.config.rootpath).as_posix()


def add_marks(item: pytest.Item) -> None:
    """Adds the marks that folders, fixtures and helpers imply; files and tests have further ones of their own."""
    assert isinstance(item, pytest.Function)
    path = path_of(item)
    if path.startswith(SLOW):
        item.add_marker("slow")
    if path.startswith(BROWSER):
        item.add_marker("browser")
    if path.startswith(SECOND_PROCESSOR):
        item.add_marker("second_processor")
    if SERVICE_FIXTURES & set(item.fixturenames) or SERVICE_STARTERS & vars(item.module).keys():
        item.add_marker("service")


@pytest.hookimpl(tryfirst=True)  # before `-m` selects
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Adds the marks; puts first what needs no kernels, where they may have to be compiled, then the longest."""
    for item in items:
        add_marks(item)

    def turn(item: pytest.Item) -> int:
        if path_of(item).startswith("tests/server/connections"):
            return 0
        return 1 + (LONGEST.index(item.path.name) if item.path.name in LONGEST else len(LONGEST))

    items.sort(key=turn)  # stable: files stay together


def pytest_xdist_auto_num_workers() -> int:
    """Processes for ``-n auto``: many tests wait for a service or a clock, so that two share a core."""
    return min(8, 2 * len(os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)))


def pytest_report_teststatus(report: pytest.CollectReport | pytest.TestReport) -> tuple[str, str, str] | None:
    """Names a test that failed at once: a run that is ended from outside prints no summary."""
    if not (isinstance(report, pytest.TestReport) and report.failed):
        return None
    crash = getattr(report.longrepr, "reprcrash", None)
    said = f": {crash.message.splitlines()[0][:200]}" if crash and crash.message else ""
    return ("failed" if report.when == "call" else "error"), f"\n{report.when} of {report.nodeid}{said}\n", "FAILED"
