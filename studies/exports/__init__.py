"""Exports, read back by other tools' readers and rendered."""
