"""Search for rings in a frame, and identification of their codes."""
