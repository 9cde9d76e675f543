"""Compiled parts of the search over given matches."""
