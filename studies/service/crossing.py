"""Source files that run while a frame passes from PUT to commit, or a render from request to response.

These are the files that a reader must open to follow a frame or a render. A file counts if at least one of its
functions runs, in any process, in both of two frames or of two renders. Unrelated work is thus ignored. Also ignored
are `__init__` files, the kernels, and the groups of effects, of which a scene has only a few. `server/repair` is
ignored because it checks the disk every few seconds in any case. The service runs as usual, with a profiler in each
process.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from client.sdk import Client
from client.wire import FrameState
from scas4d_core.captures import Capture
from studies.captures import open_measured
from studies.running.process import Service, wait_until

PACKAGES = ("scas4d_core", "server", "client")
MOST_OF_A_FRAME, MOST_OF_A_RENDER = 62, 26
"""Largest allowed numbers of files for a frame and for a render; the current numbers are 62 and 26.

Unfinished earlier work would add further files.
"""
LATER = (3, 4)
"""Frames that are traced. Frame 0 and the first updates do additional work."""
SETTINGS = {
    "scene": {"image_scale": 0.25},
    "static": {"iterations": 300, "max_gaussians": 2500},
    "update": {"iterations": 20},
}
COMMITTED_S = 120.0
SETTLE_S = 0.3
"""Pause in seconds before and after each phase, in which the processes finish related work.

The pause is short, because background work that runs every few seconds does not belong to the frame.
"""

PROFILER = """
import os, sys, threading, time
folder, codes = os.environ["CROSSING_FOLDER"], set()
def profile(frame, event, argument):
    if event == "call":
        codes.add(frame.f_code)
def follow():
    phase = ""
    while True:
        time.sleep(0.02)
        try:
            with open(os.path.join(folder, "phase")) as file:
                now = file.read()
        except OSError:
            continue
        if now != phase:
            if phase:
                with open(os.path.join(folder, phase + "." + str(os.getpid())), "w") as file:
                    file.write("\\n".join({code.co_filename for code in list(codes)}))
            codes.clear()
            phase = now
threading.Thread(target=follow, daemon=True).start()
threading.setprofile(profile)
sys.setprofile(profile)
"""
"""`sitecustomize.py` of the service's processes, which records the code that is called in each phase."""


def crossed(folder: Path, capture: Capture) -> dict[str, list[str]]:
    """Returns the sorted files that run for a "frame" and for a "render", relative to the checkout.

    Args:
        folder: folder for the service's data, created if missing.
        capture: capture with at least five frames and a test camera.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sitecustomize.py").write_text(PROFILER)
    root = Path(__file__).parents[2]
    path = os.pathsep.join((str(folder), str(root)))
    environment = {
        "PYTHONPATH": path,
        "CROSSING_FOLDER": str(folder),
        "SCAS4D_SCRUB_MB_PER_SECOND": "0",
        "SCAS4D_SLEEP_SECONDS": "0",
        "SCAS4D_LOG_LEVEL": "info",
    }
    assert capture.test_rig is not None
    camera = capture.test_rig.cameras[0]
    service = Service(folder / "data", environment)
    service.start()
    try:
        with Client(f"http://127.0.0.1:{service.port}", busy_timeout=60) as client:
            scene = client.create_scene(capture.rig, settings=SETTINGS).id
            assert capture.points is not None
            client.put_points(scene, capture.points)

            def put(index: int) -> None:
                images = {name: capture.encoded_image(index, name) for name in capture.rig.names}
                masks = {name: capture.encoded_mask(index, name) for name in capture.rig.names}
                client.put_frame(scene, index, images, {name: mask for name, mask in masks.items() if mask})

            for index in range(LATER[0]):
                put(index)
            client.wait(scene, LATER[0] - 1)
            client.render(scene, camera, LATER[0] - 1)
            for index in LATER:
                state = folder / "data" / "scenes" / scene / "states" / f"frame_{index:06d}.npz"
                with _phase(folder, f"frame {index}"):
                    put(index)
                    # Asking the service would involve other files.
                    wait_until(state.exists, "the frame was not committed", COMMITTED_S)
                assert client.frame(scene, index).state is FrameState.COMMITTED
                with _phase(folder, f"render {index}"):
                    client.render(scene, camera, index)
    finally:
        service.stop()
    return {
        phase: sorted(set.intersection(*(set(_files(folder, f"{phase} {index}", root)) for index in LATER)))
        for phase in ("frame", "render")
    }


@contextmanager
def _phase(folder: Path, name: str) -> Iterator[None]:
    for text in (name, ""):
        time.sleep(SETTLE_S)
        (folder / "phase").write_text(text)
        time.sleep(SETTLE_S)
        if text:
            yield


def _files(folder: Path, phase: str, root: Path) -> Iterator[str]:
    for match in folder.glob(f"{phase}.*"):
        for name in match.read_text().splitlines():
            path = Path(name)
            if path.is_relative_to(root):
                inside = path.relative_to(root)
                ignored = path.name == "__init__.py" or "kernels" in inside.parts
                ignored = ignored or ("effects" in inside.parts and inside.parts[-2] != "effects")
                ignored = ignored or inside.parts[:2] == ("server", "repair")
                if inside.parts[0] in PACKAGES and not ignored:
                    yield inside.as_posix()


def run(sample: Path, echo: Callable[[str], None] = print) -> bool:
    """Prints the files of a frame and of a render, and returns whether their numbers are within the limits."""
    with tempfile.TemporaryDirectory(prefix="scas4d-crossing-") as folder:
        files = crossed(Path(folder), open_measured(sample))
    for phase, most in (("frame", MOST_OF_A_FRAME), ("render", MOST_OF_A_RENDER)):
        echo(f"a {phase} runs through {len(files[phase])} files (at most {most}):")
        for name in files[phase]:
            echo(f"  {name}")
    return len(files["frame"]) <= MOST_OF_A_FRAME and len(files["render"]) <= MOST_OF_A_RENDER
