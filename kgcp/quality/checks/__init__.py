"""Plausibility of a flight's inputs: what does not fit, with its likely cause and the remedy."""
