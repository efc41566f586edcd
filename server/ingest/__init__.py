"""Accepts frames: receives, checks, writes, orders, acknowledges."""
