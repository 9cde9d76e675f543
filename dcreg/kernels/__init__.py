"""Compiled kernels: flat functions, arrays in, arrays out. their NumPy twins are in `tests/oracles`."""
