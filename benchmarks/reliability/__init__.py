"""Runs that are killed, that are long, and that must give the same bytes."""
