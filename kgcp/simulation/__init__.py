"""Rendered truth, seeded and deterministic, and the accuracy to expect; no files."""
