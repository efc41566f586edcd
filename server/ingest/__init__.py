"""Receives frames: checks, writes, orders and acknowledges them."""
