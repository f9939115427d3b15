"""Measured distances against reference poses, and the statistics of their differences."""
