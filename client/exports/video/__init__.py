"""Video rendering: camera paths, states at arbitrary times, overlays and encoding."""
