"""Cheapest k pairs: of a dense matrix, of scalars on a line, and what both are built from."""
