"""A public, seeded, deterministic flight simulator: rendered truth, no files."""
