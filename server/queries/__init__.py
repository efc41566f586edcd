"""Checks requests for views and tracks, and turns them into queries to the readers of a scene."""
