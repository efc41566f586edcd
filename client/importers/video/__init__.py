"""Reads the frames of video files in any order."""
