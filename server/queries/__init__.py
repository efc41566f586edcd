"""Validation of view and track requests, and their conversion into queries to the readers of a scene."""
