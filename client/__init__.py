"""The client: wire models, SDK, rig simulator and the `scas4d` command. Imports neither torch nor Numba."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("scas4d")
except PackageNotFoundError:  # run from a tree that is not installed
    __version__ = "0"
