"""Targets on the ground: placing them, and orienting frames by them."""
