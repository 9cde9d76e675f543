"""Comparisons beside the workflow: bounds on the same boxes, ports beside recorded official outputs."""
