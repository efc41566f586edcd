"""Validation of view and track requests, and their conversion into queries to a scene's readers."""
