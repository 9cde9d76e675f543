"""Similarities in 3D: rotation, translation and scale."""
