"""Motion effects: all on is the loop as it was, bit by bit; what is off is exactly 0 and in no optimizer."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
from box_scene import MOVING, moved, take_frame
from effect_cases import BEFORE, RIG, UPDATE, builder, same, updater_of

from scas4d_core.checkpoint import CarryOver
from scas4d_core.effects.motion.free_columns import MOVES
from scas4d_core.effects.switches import first_switches, names_on, register_effects
from scas4d_core.engines.cpu import engine as cpu_engine
from scas4d_core.engines.cpu.adam import Adam
from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.engines.engine import UpdateEngine
from scas4d_core.engines.torch.engine import TorchEngine
from scas4d_core.frame_outcome import Candidate
from scas4d_core.presets import SettingError, preset
from scas4d_core.settings import Settings, UpdateSettings
from scas4d_core.update.frame_update import FrameUpdate
from scas4d_core.update.result import AS_CONFIGURED, AttemptOptions, UpdateResult
from scas4d_core.update.warm_start import Motion

COLUMNS = {
    "cluster_rotation": slice(0, 3),
    "cluster_translation": slice(3, 6),
    "cluster_scaling": slice(6, 10),
    "own_position": slice(0, 3),
    "own_rotation": slice(3, 6),
    "own_scale": slice(6, 9),
}
COMPARED = AttemptOptions(compare=True)


def usual(update: UpdateSettings = UPDATE) -> tuple[str, ...]:
    return names_on(first_switches(Settings(update=update), 0))


def without(*names: str) -> list[str]:
    return [name for name in usual() if name not in names]


def updater(effects: Sequence[str], update: UpdateSettings = UPDATE, engine: UpdateEngine | None = None) -> FrameUpdate:
    return updater_of(register_effects(builder(update=update), effects), engine)


def run(made: FrameUpdate, motion: Motion | None = None, options: AttemptOptions = AS_CONFIGURED) -> UpdateResult:
    views = builder().factory.views(take_frame(1, 1.0, moved(BEFORE), RIG, True), {})
    return made.run(BEFORE, views, motion, 1.0, seed=3, options=options)


@cache
def found_motion() -> Motion:
    """With all columns in it: of all that moves, Gaussians alone included."""
    motion = run(updater(usual())).motion
    assert motion is not None
    return motion


class PlainTable:
    """A table as the loop stepped it before: Adam over all columns, those of rate 0 included."""

    def __init__(self, table: np.ndarray, columns: list[float], betas: tuple[float, float]) -> None:
        self._adam = Adam(table, columns, betas)
        self.guards = self._adam.guards

    def step(self, gradients: np.ndarray, factor: float) -> None:
        self._adam.step(gradients, factor)


@pytest.mark.parametrize("off", [(), ("cluster_scaling", "own_rotation"), MOVES[3:], MOVES[:3]], ids=str)
@pytest.mark.parametrize("cold", [True, False])
def test_the_state_is_that_of_steps_over_all_columns(
    off: tuple[str, ...], cold: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    motion = None if cold else found_motion()
    found = run(updater(without(*off)), motion).gaussians.arrays()
    monkeypatch.setattr(cpu_engine, "AdamColumns", PlainTable)
    assert same(found, run(updater(without(*off)), motion).gaussians.arrays())
    assert same(found, run(updater(usual()), motion).gaussians.arrays()) == (not off)


@pytest.mark.parametrize("name", MOVES)
@pytest.mark.parametrize("kind", [CpuEngine, TorchEngine])
def test_columns_that_are_off_stay_exactly_0_and_no_others(name: str, kind: type[UpdateEngine]) -> None:
    short = UPDATE.model_copy(update={"iterations": 3, "deltas_start": 0.0, "momentum": 0.5})
    engine = kind()
    run(updater(without(name), short, engine), found_motion())
    tables = engine.tables()
    for other, columns in COLUMNS.items():
        layers = tables.clusters[:1]  # the finer ones have not begun
        for table in layers if other.startswith("cluster") else [tables.deltas]:
            assert table[:, columns].any() == (other != name), other


def test_what_is_off_is_in_no_optimizer() -> None:
    stepped = []
    for effects in (["cluster_translation", "own_scale"], ["own_position"]):
        engine = CpuEngine()
        run(updater(effects, engine=engine))
        stepped.append([table for table in (*engine._layer_columns, engine._own_columns) if table is not None])
    tables, clusters_off = stepped
    assert [table._adam._first.shape[1] for table in tables] == [3, 3, 3]
    assert all(table._values.flags.c_contiguous for table in tables)  # else the kernel is compiled again for them
    assert len(clusters_off) == 1


def test_a_rigid_motion_is_found_by_clusters_that_turn_and_shift_alone() -> None:
    update = UPDATE.model_copy(update={"iterations": 60})
    state = run(updater(without("cluster_scaling", *MOVES[3:]), update)).gaussians
    truth = moved(BEFORE).means[:MOVING]
    missed = np.linalg.norm(state.means[:MOVING] - truth, axis=1)
    way = np.linalg.norm(BEFORE.means[:MOVING] - truth, axis=1)
    assert np.median(missed) < 0.15 * np.median(way)


def test_torch_obeys_the_same_freedoms() -> None:
    """The first steps, before rounding decides: the terms between neighbours have a kink at the start."""
    update = UPDATE.model_copy(update={"iterations": 3, "deltas_start": 0.0})
    ties = ("rigidity", "isometry", "rotation")
    off = without("cluster_rotation", "own_position", *ties)
    on_cpu, in_torch = (run(updater(off, update, engine)) for engine in (CpuEngine(), TorchEngine()))
    np.testing.assert_allclose(in_torch.trace.losses, on_cpu.trace.losses, rtol=2e-4)
    apart = np.linalg.norm(in_torch.gaussians.means - on_cpu.gaussians.means, axis=1)[:MOVING]
    free = run(updater(without(*ties), update)).gaussians.means
    assert np.median(apart) < 0.05 * np.median(np.linalg.norm(free - on_cpu.gaussians.means, axis=1)[:MOVING])


@pytest.mark.parametrize("kind", [CpuEngine, TorchEngine])
def test_without_prediction_an_update_starts_where_the_frame_before_ended(kind: type[UpdateEngine]) -> None:
    short = UPDATE.model_copy(update={"iterations": 2})
    still = run(updater(without("prediction"), short, kind()), found_motion(), COMPARED)
    assert set(still.trace.errors) == {Candidate.PREVIOUS, Candidate.END}
    assert same(still.gaussians.arrays(), run(updater(usual(), short, kind()), None, COMPARED).gaussians.arrays())
    warm = run(updater(usual(), short, kind()), found_motion(), COMPARED)
    assert Candidate.WARM in warm.trace.errors
    assert not same(still.gaussians.arrays(), warm.gaussians.arrays())


@pytest.mark.parametrize(
    ("given", "setting", "value", "words"),
    [
        ({"effects": dict.fromkeys(MOVES, "off")}, "cluster_rotation", "off", "set at least one of cluster_rotation, "),
        (
            {"effects": dict.fromkeys(MOVES[3:], "off"), "update": {"clusters": ()}},
            "own_position",
            "off",
            "no effect could move clusters or Gaussians",
        ),
        ({"effects": {"own_scale": "on"}, "update": {"rate_scale": 0}}, "own_scale", "on", "use a rate above 0"),
        (
            {"effects": {"cluster_scaling": "on"}, "update": {"clusters": ()}},
            "cluster_scaling",
            "on",
            "update.clusters is empty",
        ),
        (
            {"effects": {"prediction": "on", "cluster_rotation": "off", "cluster_translation": "off"}},
            "prediction",
            "on",
            "cluster_rotation and cluster_translation are 'off'",
        ),
    ],
)
def test_contradictions_are_refused(given: dict[str, object], setting: str, value: str, words: str) -> None:
    with pytest.raises(SettingError) as caught:
        preset("scas4d", given)
    assert (caught.value.setting, caught.value.value) == (f"effects.{setting}", value)
    assert words in f"{caught.value.fault}; {caught.value.remedy}"


def test_each_may_be_off_and_they_are_on_where_the_settings_allow_them() -> None:
    for name in (*MOVES, "prediction"):
        assert not first_switches(preset("scas4d", {"effects": {name: "off"}}), 0)[name].on
    assert set(usual()) >= {*MOVES, "prediction"}
    alone = usual(preset("dynamic3dgs").update)
    assert [name for name in MOVES if name in alone] == ["own_position", "own_rotation"]
    assert "prediction" in alone


def test_without_motion_of_clusters_there_is_no_cascade(preparation) -> None:  # type: ignore[no-untyped-def]
    settings = Settings(update=UPDATE, effects=dict.fromkeys(MOVES[:3], "off"))
    made = preparation(settings).rebuild(BEFORE, CarryOver(switches=first_switches(settings, 0)))
    other = preparation(Settings(update=UPDATE)).rebuild(BEFORE, CarryOver(switches=first_switches(Settings(), 0)))
    assert (made.updater.hierarchy.sizes, other.updater.hierarchy.sizes) == ((), (2, 12))
    assert np.array_equal(made.updater.hierarchy.rows, other.updater.hierarchy.rows)
    assert made.carried.structure != other.carried.structure  # a motion of the one is none of the other


def test_switches_of_an_earlier_version_are_joined_by_those_of_new_effects(preparation) -> None:  # type: ignore[no-untyped-def]
    settings = Settings(update=UPDATE, effects={"own_scale": "off"})
    switches = first_switches(settings, 0)
    before = {name: switches[name] for name in ("isometry", "rigidity")}
    prepared = preparation(settings).rebuild(BEFORE, CarryOver(switches=before))
    assert dict(prepared.carried.switches) == switches
