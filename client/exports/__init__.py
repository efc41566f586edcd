"""Writes states in the formats of other tools, as pages and as videos, from a scene, a folder or a file."""
