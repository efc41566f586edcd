"""How fast and how exactly the viewer draws, in a headless Chromium and without a service.

Two versions of the viewer are measured in turns, because other work on the machine changes all times.
"""

from __future__ import annotations

import base64
import io
import mimetypes
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from client.exports.player import VIEWER, write_player
from scas4d_core.cameras import Camera
from scas4d_core.compact import CompactReader, CompactWriter
from scas4d_core.engines.limits import rig_limits
from scas4d_core.gaussians import Gaussians
from scas4d_core.query.view import ViewRenderer
from studies.live.main_thread import main_thread_clock
from studies.machine import browser_path, in_words, machine

WIDTH, HEIGHT = 640, 360
WARM_S = 2.0
"""Time before each measurement, in which shaders compile and states are decoded."""
STATES_PER_SECOND = 30
PATIENCE_MS = 120_000
SPREAD = 0.7
"""Standard deviation of the offset of an added Gaussian from the one that it copies, in axes of the latter."""
DRAW = """async ({ base, file, camera, radius, playing, warm, seconds, statesPerSecond }) => {
  const { Splats } = await import(`${base}/splats/splats.js`);
  const canvas = document.createElement('canvas');
  Object.assign(canvas.style, { width: `${camera.width}px`, height: `${camera.height}px` });
  document.body.replaceChildren(canvas);
  const worker = new Worker(`${base}/splats/worker.js`, { type: 'module' });
  let [pictures, begun, last, loaded, ended] = [0, 0, 0];
  const origin = performance.now();
  const splats = new Splats(canvas, worker, {
    frames: ({ frames }) => ((last = frames.length - 1), loaded()),
    failed: ({ words }) => ended({ words }),
    drawn: () => (pictures++, draw()),
  });
  const draw = () => {
    const now = (performance.now() - origin) / 1000;
    const first = begun ? last : pictures; // all states are decoded before the measurement begins
    if (!begun && now > warm && first > last) [begun, pictures] = [now, 0];
    if (begun && now > begun + seconds) return ended({ rate: pictures / (now - begun) });
    const [c, s] = [Math.cos(0.3 * Math.sin(now)), Math.sin(0.3 * Math.sin(now))]; // swings about the scene's centre
    const turn = [[c, 0, s, -s * radius], [0, 1, 0, 0], [-s, 0, c, radius - c * radius], [0, 0, 0, 1]];
    const pose = turn.map((row) => camera.world_to_camera[0].map((_, j) =>
      row.reduce((sum, value, k) => sum + value * camera.world_to_camera[k][j], 0)));
    const at = (now * statesPerSecond) % (2 * last);
    const place = first < last ? first : playing ? Math.min(at, 2 * last - at) : 0;
    splats.draw({ place, camera: { ...camera, world_to_camera: pose } });
  };
  await new Promise((done) => {
    loaded = done;
    fetch(file).then((answer) => answer.arrayBuffer()).then((buffer) => splats.add(new Uint8Array(buffer)));
  });
  return await new Promise((done) => ((ended = done), draw()));
}"""
PAINT = """async ({ base, file, views }) => {
  const modules = ['reader', 'painter', 'sequence', 'rig', 'software', 'sort'];
  const loaded = await Promise.all(modules.map((name) => import(`${base}/splats/${name}.js`)));
  const { CompactReader, Painter, Sequence, inside, nearOf, Rasterizer, Sorter } = Object.assign({}, ...loaded);
  const sequence = new Sequence(Infinity);
  sequence.add(new CompactReader(new Uint8Array(await (await fetch(file)).arrayBuffer())));
  const canvas = document.createElement('canvas');
  const [painter, sorter, rasterizer, { head }] = [new Painter(canvas), new Sorter(), new Rasterizer(), sequence];
  return views.map(({ place, model }) => {
    const [moment, camera] = [sequence.moment(place), inside(model, head, nearOf(head))];
    sorter.sort(moment, camera.rows[2], null);
    painter.size(camera.width, camera.height);
    const given = [moment, camera, sorter, 'own'];
    const png = () => canvas.toDataURL('image/png').split(',')[1];
    painter.project(...given);
    painter.colours(head.background);
    const shaders = png();
    painter.show(rasterizer.paint(...given, head.background));
    return [shaders, png()];
  });
}"""


@contextmanager
def served(folders: Mapping[str, Path]) -> Iterator[str]:
    """Serves folders under their names from a free local port, with an empty page at `/`; yields the address."""
    mimetypes.add_type("text/javascript", ".js")

    class Handler(SimpleHTTPRequestHandler):
        def do_GET(self) -> None:
            if self.path.count("/") > 1:
                return super().do_GET()
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(b"<!doctype html><body></body>")

        def translate_path(self, path: str) -> str:
            name, rest = path.lstrip("/").split("/", 1)
            return str(folders[name] / rest)

        def log_message(self, *_: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()


@contextmanager
def opened(address: str) -> Iterator[Any]:
    """Yields a page of a new headless Chromium."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=browser_path(), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 800, "height": 500})
        page.set_default_timeout(PATIENCE_MS)
        page.goto(address)
        yield page
        browser.close()


def with_count(source: Path, target: Path, count: int) -> None:
    """Writes a compact file with the frames of another one, but `count` Gaussians.

    Added Gaussians are copies that lie beside others and move with them. All are smaller, so that they cover the same
    area together.
    """
    target.unlink(missing_ok=True)
    with CompactReader(source) as reader, CompactWriter(target, reader.head, clustered=False) as writer:
        known = len(reader.state(reader.frames[0]))
        rows, added = np.arange(count) % known, np.arange(count) >= known
        offsets = added[:, None] * np.random.default_rng(0).normal(scale=SPREAD, size=(count, 3))
        for index in reader.frames:
            state = reader.state(index)
            means = state.means[rows] + np.einsum("nij,nj->ni", state.factors[rows], offsets)
            names = ("rotations", "colours", "foreground", "retired")
            writer.add(
                index,
                index / STATES_PER_SECOND,
                Gaussians.of_points(means.astype(np.float32), radius=0.1).replace(
                    factors=state.factors[rows] * np.float32((known / count) ** 0.5),
                    opacities=state.own_opacities[rows],
                    **{name: getattr(state, name)[rows] for name in names},
                ),
            )


def _camera(source: Path) -> tuple[dict[str, Any], float]:
    """The first camera of a file's rig, as a request for a picture, and its distance from the scene's centre."""
    with CompactReader(source) as reader:
        camera = reader.head.rig.cameras[0]  # type: ignore[union-attr]
        points = reader.head.world.to_user(reader.state(reader.frames[0]).means)
    scale = min(WIDTH / camera.width, HEIGHT / camera.height)
    fx, fy = scale * camera.intrinsics[0][0], scale * camera.intrinsics[1][1]
    pose = camera.world_to_camera
    model = {
        "intrinsics": [[fx, 0, WIDTH / 2], [0, fy, HEIGHT / 2], [0, 0, 1]],
        "world_to_camera": pose.tolist(),
        "width": WIDTH,
        "height": HEIGHT,
    }
    return model, float(np.linalg.norm(pose[:3, :3] @ np.median(points, axis=0) + pose[:3, 3]))


def rates(source: Path, versions: Mapping[str, Path], turns: int, seconds: float) -> dict[str, list[list[float]]]:
    """Returns pictures per second, [turns] of each version in order, for a still and a playing scene.

    Args:
        source: compact file.
        versions: folder `server/viewer` of each version.
        turns: number of measurements of each version, alternating.
        seconds: duration of a measurement.
    """
    camera, radius = _camera(source)
    found: dict[str, list[list[float]]] = {kind: [[] for _ in versions] for kind in ("still", "playing")}
    with served({**versions, "file": source.parent}) as address:
        for _ in range(turns):
            for kind, rows in found.items():
                for name, row in zip(versions, rows, strict=True):
                    order: dict[str, Any] = {
                        "base": f"{address}/{name}",
                        "file": f"{address}/file/{source.name}",
                        "camera": camera,
                    }
                    order |= {"radius": radius, "playing": kind == "playing", "warm": WARM_S, "seconds": seconds}
                    with opened(address) as page:
                        answer = page.evaluate(DRAW, order | {"statesPerSecond": STATES_PER_SECOND})
                    if "words" in answer:
                        raise RuntimeError(f"{name}: {answer['words']}")
                    row.append(answer["rate"])
    return found


def main_thread_ms(source: Path, work: Path, seconds: float) -> float:
    """Returns the milliseconds of the page's main thread per picture while the exported player plays a file."""
    write_player(work / "player.html", "player", [source])
    with opened((work / "player.html").resolve().as_uri()) as page:
        page.wait_for_function("() => document.body.dataset.pictures > 0")
        page.keyboard.press(" ")
        page.wait_for_timeout(1e3 * WARM_S)
        clock, pictures = main_thread_clock(page), "Number(document.body.dataset.pictures)"
        busy, drawn = clock(), float(page.evaluate(pictures))
        page.wait_for_timeout(1e3 * seconds)
        return (clock() - busy) / max(1.0, float(page.evaluate(pictures)) - drawn)


def agreement(source: Path, views: int) -> list[tuple[float, float]]:
    """Returns the PSNR of the shaders and of the software rasterizer against the CPU renderer, for views of a file."""
    with CompactReader(source) as reader:
        head, cameras = reader.head, reader.head.rig.cameras  # type: ignore[union-attr]
        states = [reader.state(index) for index in reader.frames]
    chosen = [cameras[k * len(cameras) // views] for k in range(views)]
    orders: list[dict[str, Any]] = [
        {"place": k % len(states), "model": _model(camera)} for k, camera in enumerate(chosen)
    ]
    with served({"viewer": VIEWER, "file": source.parent}) as address, opened(address) as page:
        order = {"base": f"{address}/viewer", "file": f"{address}/file/{source.name}", "views": orders}
        answers = page.evaluate(PAINT, order)
    renderer = ViewRenderer(head.world, rig_limits("auto", head.world, cameras))
    found = []
    for camera, asked, pair in zip(chosen, orders, answers, strict=True):
        state = states[asked["place"]]
        true = renderer.render(state, camera, head.background, colours=state.colours).colour.clip(0, 1)
        shaders, software = (_psnr(png, true) for png in pair)
        found.append((shaders, software))
    return found


def _model(camera: Camera) -> dict[str, Any]:
    pose, intrinsics = np.asarray(camera.world_to_camera).tolist(), np.asarray(camera.intrinsics).tolist()
    return {"intrinsics": intrinsics, "world_to_camera": pose, "width": camera.width, "height": camera.height}


def _psnr(png: str, true: Any) -> float:
    mine = np.array(Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB")) / 255
    return float(-10 * np.log10(np.square(mine - true).mean()))


def run(
    folders: Sequence[Path], against: Path | None, counts: Sequence[int], turns: int, seconds: float, work: Path
) -> str:
    """Measures the viewer on output folders of `scas4d reconstruct`, and returns the results as Markdown tables.

    Args:
        folders: the first one is the source of the scenes whose speed is measured.
        against: folder `server/viewer` of another version, or None.
        counts: numbers of Gaussians; the last one also while the exported player plays it.
        turns, seconds: see `rates`.
        work: folder for files.
    """
    work.mkdir(parents=True, exist_ok=True)
    versions = {"before": against, "now": VIEWER} if against else {"now": VIEWER}
    lines = [f"Pictures of {WIDTH}×{HEIGHT} per second ({in_words(machine())}):", ""]
    lines += [
        "| Gaussians | " + " | ".join(versions) + " | ratio, median of turns |",
        "|---" * (len(versions) + 2) + "|",
    ]
    for count in counts:
        file = work / f"{count}.s4d"
        with_count(folders[0] / "states.s4d", file, count)
        for kind, rows in rates(file, versions, turns, seconds).items():
            ratio = np.median(np.array(rows[-1]) / rows[0])
            cells = " | ".join(f"{np.median(row):.1f}" for row in rows)
            lines.append(f"| {count:,}, {kind} | {cells} | {f'{ratio:.2f}' if against else '–'} |")
    spent = main_thread_ms(work / f"{counts[-1]}.s4d", work, seconds)
    lines += ["", f"Main thread while {counts[-1]:,} Gaussians play: {spent:.1f} ms per picture.", ""]
    lines += ["| scene | views | shaders, lowest PSNR | software, lowest PSNR |", "|---|---|---|---|"]
    views = -(-20 // len(folders))
    for folder in folders:
        shaders, software = np.min(agreement(folder / "states.s4d", views), axis=0)
        lines.append(f"| {folder.name} | {views} | {shaders:.1f} dB | {software:.1f} dB |")
    return "\n".join(lines)
