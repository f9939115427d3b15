"""Time and memory that kgcp needs."""
