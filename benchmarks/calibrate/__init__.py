"""Benchmarks of discs and of the calibration from them."""
