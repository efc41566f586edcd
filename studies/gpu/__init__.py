"""Check of the GPU engine on a machine with a GPU: tests, accuracy, times and their spread, in one run."""
