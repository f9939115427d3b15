"""Benchmarks of the measurement of discs, and of calibrations from them."""
