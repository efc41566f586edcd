"""Ingest of frames: receives, validates, stores, orders and acknowledges them."""
