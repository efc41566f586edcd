"""Studies that measure the method and the service; run by `scripts/bench`, not packaged."""
