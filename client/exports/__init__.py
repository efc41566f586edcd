"""Writes the states of a scene, a folder or a file: formats of other tools, pages, recordings."""
