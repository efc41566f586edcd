"""Durability: frame log, journal, ledger, epochs, recovery."""
