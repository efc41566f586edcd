"""How fast the viewer draws: pictures per second, its share of the page's thread, and its error against the CPU rasterizer.

The page's own painter runs in a headless Chromium on compact files, without a service. Versions of the viewer are
measured in turns, because other work on the machine changes all times.
"""

from __future__ import annotations

import base64
import functools
import io
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from scas4d_core.compact import CompactReader, CompactWriter
from scas4d_core.gaussians import Gaussians
from studies.machine import browser_path

SIZE = (640, 360)
WARM_S = 1.0
"""Time before each measurement, in which shaders compile and states are decoded."""
STATES_PER_SECOND = 30
DRAW = """async ({ base, file, mostBytes, camera, radius, playing, warm, seconds, statesPerSecond }) => {
  const { Splats } = await import(`${base}/splats/splats.js`);
  const canvas = Object.assign(document.createElement('canvas'), { style: 'width:640px;height:360px' });
  document.body.replaceChildren(canvas);
  const worker = new Worker(`${base}/splats/worker.js`, { type: 'module' });
  let [pictures, decoding, begun, frames] = [0, 0, 0, 0];
  let ready, done;
  const [started, ended] = [new Promise((one) => (ready = one)), new Promise((one) => (done = one))];
  const drawn = () => {};
  const splats = new Splats(canvas, worker, { frames: (message) => (frames = message.frames.length, ready()), failed: ({ words }) => done(words),
    drawn: (message) => (pictures++, decoding += message.decoding, next()) }, mostBytes);
  splats.add(new Uint8Array(await (await fetch(file)).arrayBuffer()));
  await started;
  const [m, origin] = [camera.world_to_camera, performance.now()];
  const next = () => {
    const now = (performance.now() - origin) / 1000;
    if (begun === 0 && now > warm) [begun, pictures, decoding] = [now, 0, 0], window.begun();
    if (begun && now > begun + seconds) return window.ended(), done({ rate: pictures / (now - begun), decoding: decoding / pictures });
    const angle = 0.3 * Math.sin(now);
    const [c, s] = [Math.cos(angle), Math.sin(angle)]; // the camera swings about the scene's centre
    const turn = [[c, 0, s, -s * radius], [0, 1, 0, 0], [-s, 0, c, radius - c * radius], [0, 0, 0, 1]];
    const pose = turn.map((row) => [0, 1, 2, 3].map((j) => row.reduce((sum, value, k) => sum + value * m[k][j], 0)));
    const last = frames - 1;
    const at = (now * statesPerSecond) % (2 * last);
    const place = playing ? Math.min(at, 2 * last - at) : 0;
    splats.draw({ place, camera: { ...camera, world_to_camera: pose } });
  };
  next();
  const found = await ended;
  splats.close();
  return found;
}"""
