"""Kernels of the DC bound over similarities in the plane."""
