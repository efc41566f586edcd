"""Exports, read back by other programs' readers and rendered."""
