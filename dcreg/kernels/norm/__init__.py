"""Kernels over translations in norm space."""
