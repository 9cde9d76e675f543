"""Pose families: parameters, objective, initial poses and bounds, one folder each."""
