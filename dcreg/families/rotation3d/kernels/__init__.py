"""Compiled parts of the rotation."""
