"""Compiled parts of the rigid pose."""
