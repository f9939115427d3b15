"""The benefit of KGCPs in aerial triangulation."""
