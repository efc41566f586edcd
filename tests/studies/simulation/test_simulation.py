"""The simulation: its checks pass for the real mechanism and fail for broken ones; its clock; the same seed."""

from __future__ import annotations

import asyncio
import threading

import pytest

from server.storage import fencing
from server.updates import worker_process
from studies.simulation import cluster, process
from studies.simulation.clock import StandstillError, run_virtual
from studies.simulation.failures import Failure
from studies.simulation.simulate import Sizes, simulate
from studies.simulation.targets import rows, summarize

SMALL = Sizes(scenes=40, nodes=8, failures=60, frames=20)


def missed(outcome) -> list[str]:
    return [row.what for row in rows(outcome) if not row.reached]


@pytest.mark.parametrize("seed", [0, 1])
def test_nothing_is_lost_or_run_twice(seed: int) -> None:
    outcome = simulate(Sizes(40, 8, 60, 20, seed))
    assert missed(outcome) == []
    assert outcome.frames.read == 40 * 20 + SMALL.more * 10
    assert sum(outcome.happened.values()) == 60
    assert set(outcome.happened) == set(Failure)
    assert outcome.adrift > 100  # workers went on after they were given up
    assert outcome.frames.again > 0  # and committed in the midst of a takeover
    assert len(outcome.waited) >= SMALL.more // 2  # scenes beyond the room
    assert "| acknowledged frames lost | 0 | 0 of 920 | reached |" in summarize(outcome)


def test_the_same_seed_gives_the_same_outcome() -> None:
    assert simulate(SMALL) == simulate(SMALL)
    assert simulate(SMALL) != simulate(Sizes(40, 8, 60, 20, seed=1))


def test_workers_that_share_an_epoch_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    begin = worker_process.begin_epoch

    def same(states, lock):
        return begin(states, lock) if (epoch := fencing.current_epoch(states)) is None else epoch

    monkeypatch.setattr(worker_process, "begin_epoch", same)
    outcome = simulate(SMALL)
    assert outcome.frames.foreign > 0
    assert outcome.frames.twice > 0


def test_states_that_are_not_taken_over_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fencing, "_link_all", lambda source, target: True)
    outcome = simulate(SMALL)
    assert outcome.frames.twice > 0


def test_a_link_that_is_not_moved_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    point = fencing._point_link
    monkeypatch.setattr(
        fencing,
        "_point_link",
        lambda states, epoch: None if states.is_symlink() and epoch > 2 else point(states, epoch),
    )
    monkeypatch.setattr(worker_process, "remove_earlier_epochs", lambda states, epoch: [])
    monkeypatch.setattr("studies.simulation.simulate.PATIENCE_S", 60.0)
    outcome = simulate(SMALL)
    assert outcome.frames.lost > 0
    assert outcome.folders > 0


def test_workers_beside_one_another_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    start = process.SimulatedPlacement.start

    def twice(self, entry, spec, on_message, on_end):
        start(self, entry, spec, lambda message: None, lambda why: None)
        return start(self, entry, spec, on_message, on_end)

    monkeypatch.setattr(process.SimulatedPlacement, "start", twice)
    assert simulate(SMALL).frames.beside > 0


def test_slow_places_and_untold_reasons_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "PLACED_PER_S", 0.1)
    monkeypatch.setattr(process.SimulatedProcess, "_explain", lambda self: None)
    found = missed(simulate(SMALL))
    assert "workers placed within 10 s while a node has room" in found
    assert "workers unplaced for 3 s whose scene reports no reason" in found


def test_the_clock_jumps() -> None:
    async def main() -> list[tuple[float, str]]:
        loop, found = asyncio.get_running_loop(), []

        async def wait(seconds: float, name: str) -> None:
            await asyncio.sleep(seconds)
            found.append((loop.time(), name))

        await asyncio.gather(wait(3600, "b"), wait(60, "a"), wait(86_400 * 3, "c"))
        return found

    assert run_virtual(main()) == [(60, "a"), (3600, "b"), (86_400 * 3, "c")]


def test_threads_of_the_clock_are_none() -> None:
    async def main() -> tuple[int, float]:
        def blocking() -> int:
            return threading.get_ident()

        found = await asyncio.to_thread(blocking)
        with pytest.raises(ZeroDivisionError):
            await asyncio.to_thread(lambda: 1 // 0)
        return found, asyncio.get_running_loop().time()

    assert run_virtual(main()) == (threading.get_ident(), 0.0)


def test_a_standstill_is_told() -> None:
    async def main() -> None:
        await asyncio.get_running_loop().create_future()

    with pytest.raises(StandstillError):
        run_virtual(main())
