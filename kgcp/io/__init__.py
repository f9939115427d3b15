"""Paths to records and back; decides nothing."""
