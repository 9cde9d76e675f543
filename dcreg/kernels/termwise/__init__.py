"""Kernels of the term-wise relaxations."""
