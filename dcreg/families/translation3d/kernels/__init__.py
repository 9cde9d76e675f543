"""Compiled parts of the translation in norm space."""
