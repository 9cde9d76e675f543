"""Compiled parts of the difference-of-convex bounds."""
