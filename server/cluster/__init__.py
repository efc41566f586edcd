"""Runs the processes of scenes on the nodes of a Ray cluster."""

import os

# A question that comes after the service has left its cluster must not start another one.
os.environ.setdefault("RAY_ENABLE_AUTO_CONNECT", "0")
