"""Studies outside the workflow: bounds, 3D modes, real clouds, recorded results of other solvers."""

REFERENCE = "dc"  # the bound whose loss is the unit of the losses in the study of bounds
N_FITTED = 6  # an order is fitted to this many of the smallest widths ...
SHOWING = 1e-3  # ... among those at which the loss exceeds this share of the optimum
