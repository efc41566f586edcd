"""Requests of clients for views and tracks, checked and made into queries to a scene's readers."""
