"""Queries on committed states: views, tracks, parts, joints and PLY files."""
