"""Targets on the ground: their positions, and poses of frames that show them."""
