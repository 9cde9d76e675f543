"""Compiled functions of the shared parts. Numba infers their types, so they have no annotations."""
