"""Videos: camera paths, states at any time, overlays, encoding."""
