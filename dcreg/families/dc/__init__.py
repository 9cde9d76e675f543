"""The difference-of-convex bounds, shared by the 2D similarity and the 3D translation."""
