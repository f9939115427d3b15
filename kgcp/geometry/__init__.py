"""Cameras, conics, circles and poses: numpy, scipy and numba only, no files."""
