"""Frame rate and latency of the whole service with an engine whose iterations take no time."""
