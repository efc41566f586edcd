"""Client package: wire models, SDK, rig simulator and the `scas4d` command; it imports neither torch nor Numba."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("scas4d")
except PackageNotFoundError:  # run from a source tree that is not installed
    __version__ = "0"
