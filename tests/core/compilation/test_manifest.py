"""The list of kernels has what scenes call: after the groups of a scene, nothing is compiled."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from scas4d_core.compilation.compiling import types_of
from scas4d_core.compilation.manifest import KERNELS, KernelGroup, kernels_of

ROOT = Path(__file__).parents[3]

PROGRAM = """
import json, sys
import numpy as np
from numba.core import event
from scas4d_core.captures import open_capture
from scas4d_core.presets import preset
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.warm_up import first_frame_groups, update_groups, compile_in_processes

compiled = []
class Heard(event.Listener):
    def on_start(self, one): compiled.append(one.data["dispatcher"].py_func.__name__)
    def on_end(self, one): pass
event.register("numba:compile", Heard())

given = json.loads(sys.argv[1])
capture = open_capture("samples/robot")
settings = preset("scas4d", given["settings"])
masked = given["masked"]
def frame(index):
    from dataclasses import replace
    found = capture.frame(index)
    return found if masked else replace(found, masks={})
points = capture.points if given["points"] else None
compile_in_processes(first_frame_groups(points=points is not None))
scene = Reconstruction.start(capture.rig, frame(0), settings, points=points)
first = list(compiled)
compile_in_processes(update_groups(settings.update.covariance))
for index in (1, 2, 3): scene.step(frame(index))
update = compiled[len(first):]
camera = capture.test_rig.cameras[0]
scene.render(camera)
scene.tracks_of_pixels(camera, np.array([[99.5, 119.5]]), 0, [0, 1])
scene.parts(4)
print(json.dumps([first, update, compiled[len(first) + len(update):]]))
"""
QUICK = {"scene": {"image_scale": 0.25}, "static": {"iterations": 60}, "update": {"iterations": 20}}


@pytest.mark.slow
@pytest.mark.parametrize(
    "given",
    [
        {"points": True, "masked": True, "settings": QUICK},
        {
            "points": True,
            "masked": False,
            "settings": {**QUICK, "update": {"iterations": 20, "covariance": "separate"}},
        },
        {"points": False, "masked": True, "settings": {**QUICK, "effects": {"direction": "on"}}},
    ],
    ids=["the sample", "separate, no masks", "no points, gloss"],
)
def test_a_scene_compiles_nothing_once_its_groups_are_there(given):
    command = [sys.executable, "-c", PROGRAM, json.dumps(given)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    first, update, queries = json.loads(done.stdout.splitlines()[-1])
    assert (first, update, queries) == ([], [], [])


def test_every_kernel_is_listed_once_in_one_group():
    calls = [(kernel.module, kernel.name, kernel.arguments) for kernel in KERNELS]
    assert len(set(calls)) == len(calls)
    assert len({kernel.key for kernel in KERNELS}) == len(KERNELS)
    assert kernels_of(KernelGroup) == sorted(KERNELS, key=lambda kernel: list(KernelGroup).index(kernel.group))


@pytest.mark.parametrize("kernel", KERNELS, ids=lambda kernel: kernel.key)
def test_the_types_are_as_many_as_the_arguments(kernel):
    from importlib import import_module

    function = getattr(import_module(f"scas4d_core.{kernel.module}"), kernel.name)
    assert len(types_of(kernel.arguments)) == function.py_func.__code__.co_argcount
