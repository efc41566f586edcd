"""Studies of third-party rigs and wrong calibrations."""
