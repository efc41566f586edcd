"""The calibration held against the pictures of frame 0: measured always, refined on request."""
