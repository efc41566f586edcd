"""Limits of connections, before the application sees a request: sizes, deadlines, number per address."""
