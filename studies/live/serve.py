"""A service whose workers use the null engine: `python -m studies.live.serve --port 8000`."""

from __future__ import annotations

import argparse

import uvicorn

from server.app import create_app
from server.connections.config import uvicorn_config
from server.processes.placement import Placement
from server.settings import ServerSettings
from studies.live.null_engine import install

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--port", type=int, required=True)
    app = create_app(ServerSettings.from_environment(), Placement(install))
    uvicorn.Server(uvicorn_config(app, port=parser.parse_args().port, log_level="error")).run()
