"""Initial points from the images of one frame: triangulation, visual hull, stereo and planes."""
