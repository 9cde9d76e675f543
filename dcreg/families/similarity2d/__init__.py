"""2D similarity."""
