"""One grey array in, one observation (or a named rejection) out."""
