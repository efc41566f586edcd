"""Committed states on disk: history, frame files, checkpoint."""
