"""HTTP service that ingests frames, reconstructs scenes in worker processes, and serves views, tracks and parts."""
