"""Initial points from the pictures of one moment: triangulation, visual hull, stereo, planes."""
