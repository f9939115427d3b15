"""Targets to be printed: codes that cannot be confused, and sheets of paper with rings on them."""
