"""Frames that are hard to search, and photographs that show no target."""
