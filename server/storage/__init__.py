"""Durable storage of scenes: frame log, journal, ledger, worker epochs and recovery."""
