"""Frames from disk or from an object store, their headers and their EXIF."""
