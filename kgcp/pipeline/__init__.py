"""Use cases: detect, export, bias report, simulate; each a flight in, files out."""
