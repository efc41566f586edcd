"""Videos: paths of the camera, states at times, what is drawn over pictures, and the encoding."""
