"""The coded target: geometry, validation, code design and artwork."""
