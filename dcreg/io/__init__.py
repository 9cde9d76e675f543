"""Readers of point clouds, with errors that say how to fix the file, and writers of results.

Readers need only NumPy, and SciPy for ``.mat``; those of laser scans need further packages. A new format
is one more reader in the table of `dcreg.io.points`.
"""

from dcreg.io.points import READERS, read_candidates, read_matches, read_points, read_weights
from dcreg.io.pose import read_pose

__all__ = ["READERS", "read_candidates", "read_matches", "read_points", "read_pose", "read_weights"]
