"""A core without a method: it keeps the contract of the real one and does what the first picture's red says.

``install`` puts it in the place of the core's modules in a process of a service: ``Running`` passes it to the service's
`Placement`; for services that are started as commands, `fake_core/sitecustomize.py` calls it (see ``environment``).
"""

from __future__ import annotations

import os
import sys
import time
from dataclasses import asdict, dataclass, field
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np

from scas4d_core.engines.renderer import levels
from scas4d_core.gaussians import Gaussians
from scas4d_core.storage.history import History, HistoryError, run_now

SLOW, SLOW_RAISES, RAISES, DIES = 200, 201, 250, 251
HELD, LEAVES_OUT, STANDS, GUESSED, REFINES, LATE = 240, 241, 242, 243, 244, 245
LOOKED_AT = 246
"""A frame with that red takes long enough for a browser on a busy machine to show that it is at work."""
WAITS = 247
"""A frame with that red is at work until the file exists that the variable FAKE_GO_ON names."""
WRITES_LATE, CANNOT_BE_WRITTEN = 238, 239
"""A frame with the first red is written once the file exists that the variable FAKE_GO_ON names; one with the second
red, never."""
PICKY, PICKED = 249, 77
"""A first frame with that red fails, unless static.iterations are those."""
ITERATIONS = 100
MS_EACH = 2.0
RAISES_IN_REPLAY, DIES_IN_REPLAY = 666, 667
SLOW_S, LOOKED_AT_S = 2.0, 6.0
STEP_M = 0.125
HANGS, KILLS = 777_001, 777_002
"""Ids that the reader never finds, or dies of."""


@dataclass
class Progress:
    stage: str
    done: int
    total: int
    detail: dict[str, float] = field(default_factory=dict)


@dataclass
class Report:
    index: int
    time: float
    iterations: int
    seconds: dict[str, float]
    loss: list[float]
    psnr: float
    moving: int
    gaussians: int


def obey(frame):
    time.sleep(float(os.environ.get("FAKE_UPDATE_S", "0")))
    red = int(next(iter(frame.images.values()))[0, 0, 0])
    if red in (SLOW, SLOW_RAISES):
        time.sleep(SLOW_S)
    if red == LOOKED_AT:
        time.sleep(LOOKED_AT_S)
    while red == WAITS and not os.path.exists(os.environ["FAKE_GO_ON"]):
        time.sleep(0.01)
    if red in (RAISES, SLOW_RAISES):
        raise FloatingPointError("the fake was told to raise")
    if red == DIES:
        os._exit(7)
    return red


def write_late(red):
    if red == CANNOT_BE_WRITTEN:
        raise OSError("the fake disk is broken")
    while not os.path.exists(os.environ["FAKE_GO_ON"]):
        time.sleep(0.01)


def state(points, index, before=None, red=0):
    """What depends on all frames so far is in the colours: a frame lost, or done twice, shows."""
    count = len(points)
    colour = np.float32(0.5 if before is None else before * np.float32(0.5) + np.float32(red / 512) + 0.125)
    offset = np.array([STEP_M * index, 0, 0])
    return Gaussians(
        means=(points + offset).astype(np.float32),
        factors=np.tile(0.05 * np.eye(3, dtype=np.float32), (count, 1, 1)),
        rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        opacities=np.full(count, 0.9, np.float32),
        colours=np.full((count, 3), colour, np.float32),
        foreground=np.ones(count, np.float32),
        ids=np.arange(count),
    )


def refined(camera):
    """The calibration of frame 0 with one camera shifted."""
    pose = camera.world_to_camera.copy()
    pose[0, 3] += 0.25
    figures = {"rotation_deg": 0.0, "translation": 0.25, "focal": 1.0, "before": 2.0, "after": None, "fixed": False}
    outcome = {"accepted": True, "text": "", "before": 2.0, "after": 0.5, "matches": 100}
    return {
        "cameras": {"c0": {"pixels": None, "matches": 3}},
        "miscalibrated": [camera.name],
        "warnings": [f"the fake refined {camera.name}"],
        "refined": {**outcome, "cameras": {camera.name: {**figures, "pose": pose.tolist()}}},
    }


@dataclass
class Resumed:
    index: int
    undone: list[int]
    faults: list[str]
    cold: bool


class FakeReconstruction:
    def __init__(self, points, history, resumed=None):
        self.points = points
        self.history = history
        self.resumed = resumed
        self.iterations = ITERATIONS

    @classmethod
    def start(
        cls, rig, frame, settings, *, points, progress, history, dropped=None, notes=None, started=None, defer=run_now
    ):
        assert started is None or started <= time.perf_counter()
        if obey(frame) == PICKY and settings.static.iterations != PICKED:
            raise FloatingPointError("the fake is picky")
        for done in range(3):
            progress(Progress("fitting", done + 1, 3, {"psnr": 30.0}))
        given = points.positions if points is not None else np.array([[0.0, 0, 0], [0.5, 0, 0]])
        # As states keep them: one that is resumed before the first update goes on with the same bits.
        scene = cls(rig.world_frame().to_inside(given).astype(np.float32), history)
        if int(next(iter(frame.images.values()))[0, 0, 0]) == REFINES:
            notes = {**(notes or {}), "calibration": refined(rig.cameras[1])}
        scene.commit(frame, dropped, notes, defer)
        return scene

    @classmethod
    def resume(cls, rig, settings, history, *, held=lambda index: True):
        first, faults = history.indices[0], list(history.damaged.values())
        for last in reversed(history.indices):
            try:
                history.gaussians(last)
                history.report(last)
                break
            except HistoryError as error:
                faults.append(str(error))
        offset = np.array([STEP_M * first, 0, 0])
        points = history.gaussians(first).means - offset
        return cls(points, history, Resumed(last, history.truncate(last), faults, False))

    def commit(self, frame, dropped, notes, defer=run_now):
        count = len(self.points)
        report = Report(frame.index, frame.time, self.iterations, {"update": 0.01}, [0.5, 0.25], 31.5, count, count)
        known = self.history.indices
        before = self.history.gaussians(known[-1]).colours[0, 0] if known else None
        red = int(next(iter(frame.images.values()))[0, 0, 0])
        outcome = {HELD: "rejected_misfit", STANDS: "unchanged"}.get(red, "updated")
        record = {
            **asdict(report),
            "outcome": outcome,
            "used": list(frame.images),
            "dropped": dropped or {},
            **(notes or {}),
        }
        if red == HELD:
            record |= {"degraded": "previous state kept: the fake was asked to", "candidate": "previous", "used": []}
        if red == STANDS:
            record |= {"iterations": 0, "candidate": "previous", "used": []}
        if red == LEAVES_OUT:
            record["dropped"] = {**record["dropped"], "c1": "it shows nothing"}
            out = {"kind": "camera_left_out", "camera": "c1", "evidence": "left out of this frame: it shows nothing"}
            record["alarms"] = [*record.get("alarms", []), out]
        if red == LATE:
            record["timing"] = {"c0": {"frames": 0.0, "error": 0.02, "out_of_step": False}}
            record["timing"]["c1"] = {"frames": 0.4, "error": 0.02, "out_of_step": True}
        if red == GUESSED and not known:
            record |= {
                "cloud": {"method": "volume", "points": count, "coverage": 0.0},
                "shortened": ["no stereo"],
                "grey": ["c1"],
            }
        first = self.iterations // 2
        record["curve"] = [
            {"iterations": first, "milliseconds": MS_EACH * first, "loss": 0.5},
            {"iterations": self.iterations, "milliseconds": MS_EACH * self.iterations, "loss": 0.25},
        ]
        record["errors"] = {"previous": 0.5, "end": 1 / self.iterations}
        record |= {"candidate": record.get("candidate", "end"), "attempts": ["as set"], "threads": 2}
        if red in (WRITES_LATE, CANNOT_BE_WRITTEN):
            defer(lambda: write_late(red))
        self.history.append(frame.index, frame.time, state(self.points, frame.index, before, red), record, defer=defer)
        return report

    def step(self, frame, *, dropped=None, notes=None, started=None, defer=run_now, defer_cleanup=None):
        assert started is None or started <= time.perf_counter()
        obey(frame)
        return self.commit(frame, dropped, notes, defer)

    def set_budget(self, *, iterations=None, budget_ms=None, stop_gain=None, skip_tolerance=None):
        self.iterations = int(budget_ms / MS_EACH) if budget_ms else iterations or ITERATIONS

    def write_checkpoint(self, index):
        return False  # it needs none


def inside_the_image(history, world, positions, indices, camera, index, limits=None):
    """Visibility without kernels: nothing hides anything."""
    uv, z = camera.project(positions)
    return (z > 0) & ((uv >= 0) & (uv < (camera.width, camera.height))).all(axis=-1)


class FakeCommitted:
    def __init__(self, history, world, limits, device="cpu"):
        from scas4d_core.query import tracks  # in the readers alone: it loads SciPy

        self.history = history
        self.world = world
        self.find = tracks

    def render(self, camera, index, *, background, labels=None):
        self.history.gaussians(index)
        colour = np.broadcast_to(np.array(background or (0, 0, 0), np.float32), (camera.height, camera.width, 3)).copy()
        colour[0, 0] = min(1, index / 10)  # which frame this is
        depth = np.full(colour.shape[:2], 2.0)
        depth[0, 0], depth[0, 1:2] = np.nan, 4.0
        parts = None if labels is None else np.full(colour.shape[:2], labels.max() + 1, np.uint8)
        return SimpleNamespace(colour=colour, alpha=np.ones(colour.shape[:2]), depth=depth, parts=parts)

    def render_levels(self, camera, index, background, *, opacity):
        view = self.render(camera, index, background=background)
        return levels(view.alpha if opacity else view.colour)

    def _depth(self, camera, index):
        return np.full((camera.height, camera.width), np.inf), np.zeros((camera.height, camera.width))

    def tracks_of_points(self, points, index, indices):
        return self.find.tracks_of_points(self.history, self.world, points, index, indices)

    def tracks_of_pixels(self, camera, uv, index, indices):
        return self.find.tracks_of_pixels(self.history, self.world, camera, uv, index, indices, self._depth)

    def tracks_of_ids(self, ids, indices):
        if HANGS in ids:
            time.sleep(600)
        if KILLS in ids:
            os._exit(9)
        return self.find.tracks_of_ids(self.history, self.world, ids, indices)

    def with_visibility(self, found, camera, index):
        return found.with_visibility(self.history, self.world, camera, index)

    def parts(self, count, previous=None):
        return np.arange(len(self.history.gaussians(0))) % (count or 2)

    def joints(self, labels, indices):
        from scas4d_core.query.joints import joints

        return joints(self.history, labels, self.world, indices)

    def write_ply(self, path, index):
        path.write_bytes(b"ply\n" + str(index).encode())


def recompute(rig, settings, history, base, frame, budget, *, dropped=None, notes=None):
    obey(frame)
    first = history.indices[0]
    copy = History()
    copy.append(base, history.time(base), history.gaussians(base), history.report(base))
    points = history.gaussians(first).means - np.array([STEP_M * first, 0, 0])
    scene = FakeReconstruction(points, copy)
    scene.set_budget(**budget)
    scene.commit(frame, dropped, {**(notes or {}), "recomputed": True})
    report = copy.report(frame.index)
    history.replace(frame.index, frame.time, copy.gaussians(frame.index).arrays(), report)
    return report


def replay(rig, settings, history, base, frames, iterations, over):
    history.gaussians(base)
    indices = []
    for decode in frames:
        frame, _ = decode()
        obey(frame)
        indices.append(frame.index)
        over()
    if iterations == RAISES_IN_REPLAY:
        raise FloatingPointError("the fake was told to raise")
    if iterations == DIES_IN_REPLAY:
        os._exit(7)
    return SimpleNamespace(
        iterations=iterations, milliseconds=3.0 * iterations, error=1 / iterations, psnr=30.0,
        frames=len(indices) - 1,
    )  # fmt: skip


def warm_up(told):
    told(1, 3)
    if "FAKE_FAULT" in os.environ:
        raise FloatingPointError("the fake was told to raise")
    until = os.environ.get("FAKE_WARM_UP_UNTIL")  # the name of a file that somebody makes
    while until is not None and not os.path.exists(until):
        time.sleep(0.01)


def install(**others):
    """Puts the fake, or `others` of the same names, in the place of the core's modules in this process."""
    of_core = {
        "scas4d_core.reconstruction": {"Reconstruction": FakeReconstruction},
        "scas4d_core.query.committed": {"CommittedScene": FakeCommitted},
        "scas4d_core.query.visibility": {"find_visibility": inside_the_image},
        "scas4d_core.recompute": {"recompute": recompute},
        "scas4d_core.replay": {"replay": replay},
        "scas4d_core.warm_up": {
            "warm_up": warm_up,
            "warm_up_updates": lambda: None,
            "compile_in_processes": lambda *groups, **more: None,
            "first_frame_groups": lambda **given: (),
            "update_groups": lambda covariance: (),
        },
        "numba": {"set_num_threads": lambda count: None},  # nothing here needs it, and loading it takes a second
    }
    for name, members in of_core.items():
        module = ModuleType(name)
        module.__spec__ = ModuleSpec(name, None)
        module.__dict__.update({member: others.get(member, fake) for member, fake in members.items()})
        sys.modules[name] = module


def environment(*folders, **more):
    """The environment of a command whose processes have the fake in place of the core; `folders` go before it."""
    helpers = Path(__file__).parent
    path = [*folders, helpers / "fake_core", helpers, helpers.parents[1]]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, path)), **more}
