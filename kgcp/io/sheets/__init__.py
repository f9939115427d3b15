"""Sheets of paper as files at true scale: PDF, SVG, DXF and PNG."""
