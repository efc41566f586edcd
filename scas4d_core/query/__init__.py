"""Answers from committed states: views, tracks, parts, ply."""
