"""Kernels over rotations and rigid poses in space."""
