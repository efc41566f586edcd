"""Execution of scene processes on the nodes of a Ray cluster."""

import os

# A Ray call made after the service has left its cluster must not start a new cluster.
os.environ.setdefault("RAY_ENABLE_AUTO_CONNECT", "0")
