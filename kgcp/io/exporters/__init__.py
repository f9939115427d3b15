"""Writers of KGCPs, one module per receiving package."""
