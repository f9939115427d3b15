"""What KGCPs are worth in aerial triangulation."""
