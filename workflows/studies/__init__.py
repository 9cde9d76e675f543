"""Comparisons beside the workflow: bounds on the same boxes, our solvers beside recorded others."""
