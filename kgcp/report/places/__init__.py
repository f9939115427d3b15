"""The report of placed targets."""
