"""Compiled functions of the shared parts: numba infers their types, so they bear no annotations."""
