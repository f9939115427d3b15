"""Fields of plain discs and rings: their geometry, and who is who in a photograph."""
