"""Plain discs and rings: found, outlined and measured, without a camera and without codes."""
