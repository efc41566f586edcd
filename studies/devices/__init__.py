"""Study that compares the devices: the same frames on the CPU and on a GPU, from the same frame 0."""
