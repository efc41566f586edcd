"""Durable storage of scenes: frame log, journal, ledger, epochs and recovery."""
