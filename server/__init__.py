"""HTTP service that accepts frames, runs scenes in worker processes, and serves views, tracks and parts."""
