"""Durability: record log, journal, ledger, frame store, recovery."""
