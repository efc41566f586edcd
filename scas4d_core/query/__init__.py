"""Queries on committed states: views, tracks, parts and PLY files."""
