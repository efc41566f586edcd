"""The `scas4d` command line."""
