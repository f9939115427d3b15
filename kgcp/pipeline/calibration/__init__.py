"""Photographs of a field of targets into a camera."""
