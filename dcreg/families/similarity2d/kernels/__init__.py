"""Compiled parts of the 2D similarity."""
