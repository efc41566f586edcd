"""Rigs that are made up, as folders."""
