"""Compiled parts of the registration over correspondences."""
