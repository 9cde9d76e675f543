"""Pose families: parameters, objective, starts and bounds, one folder each."""
