"""Studies of reconstruction quality: captures, settings and seeds compared with the ground truth."""
