"""Faulty frames and long runs on small footage: what is sent, and the checks that the result must pass."""
