"""Kernels for residuals between features: points in the plane, or norms of points in space."""
