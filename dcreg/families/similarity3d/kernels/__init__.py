"""Compiled parts of the search over similarities in 3D."""
