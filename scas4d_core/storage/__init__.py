"""Committed states on disk: history, frame files, chunks."""
