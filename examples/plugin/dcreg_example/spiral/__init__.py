"""A spiral in 2D."""
