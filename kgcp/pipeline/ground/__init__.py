"""Targets on the ground: placed from many frames, and frames oriented by them."""
