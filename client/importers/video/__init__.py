"""Reading of video files frame by frame with PyAV, in any order, with an index of the visible frames."""
