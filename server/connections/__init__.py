"""Limits enforced before a request reaches the application: sizes, deadlines and connections per address."""
