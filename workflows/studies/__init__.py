"""Studies outside the workflow: bounds, 3D modes, real clouds, recorded results of other solvers."""

REFERENCE = "dc"  # the bound whose loss is the unit of the losses in the study of bounds
