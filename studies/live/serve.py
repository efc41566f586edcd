"""A service whose workers use the null engine, or commit recorded states.

Example: `python -m studies.live.serve --port 8000 [--states out/robot/states]`.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import uvicorn

from server.app import create_app
from server.connections.config import uvicorn_config
from server.processes.placement import Placement
from server.settings import ServerSettings
from studies.live import null_engine, playback

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--states", type=Path)
    options = parser.parse_args()
    prepare = null_engine.install if options.states is None else partial(playback.install, options.states)
    app = create_app(ServerSettings.from_environment(), Placement(prepare))
    uvicorn.Server(uvicorn_config(app, port=options.port, log_level="error")).run()
