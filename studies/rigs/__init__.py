"""Studies of rigs: those of other people, calibrations that are off, and cameras that drift."""
