"""Where the rings of a frame are, and whose code they carry."""
