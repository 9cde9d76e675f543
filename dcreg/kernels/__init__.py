"""Compiled kernels: flat functions, arrays in, arrays out. `reference` holds their NumPy twins."""
