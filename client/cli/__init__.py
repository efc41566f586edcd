"""The `scas4d` command."""
