"""Studies of third-party rigs, wrong calibrations and drifting cameras."""
