"""Detection and repair of damaged files."""
