"""Geometry of cameras, conics, circles and poses: numpy and scipy only, no files."""
