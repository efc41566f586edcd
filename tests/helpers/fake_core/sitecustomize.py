"""Imported by every Python process that has this folder on PYTHONPATH: the fake takes the place of the core."""

import fakes

fakes.install()
