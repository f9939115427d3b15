"""Tests of long runs, of runs that are killed, and of results that must be the same bytes."""
