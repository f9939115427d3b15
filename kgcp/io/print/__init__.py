"""Printable sheets as files at true scale: PDF, SVG, DXF and PNG."""
