"""Faulty pictures and cameras, and long runs."""
