"""Adjustment of the cameras, poses and points behind many photographs of circular targets."""
