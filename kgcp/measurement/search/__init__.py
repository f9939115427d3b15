"""Search for rings in a frame, and for their codes."""
