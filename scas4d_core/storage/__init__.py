"""Committed states on disk: history, frame files, chunks of older states, and retention."""
