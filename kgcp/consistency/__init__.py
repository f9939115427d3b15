"""Whether the vehicle and the reference poses put the target in the same places."""
