"""Compiled assignment algorithms."""
