"""The bias study as a page, its figures and its numbers."""
