"""The bias report: its page, its figures and its numbers."""
