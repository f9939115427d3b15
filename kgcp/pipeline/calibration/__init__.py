"""Calibration of a camera from photographs of a field of targets."""
