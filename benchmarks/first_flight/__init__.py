"""First flights: bare folders as they come from card and rover, and the way from them to points."""
