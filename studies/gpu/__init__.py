"""Check of the GPU engine in one run: tests, accuracy, times, and the spread of identical reconstructions."""
