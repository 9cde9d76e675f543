"""Reading point clouds from the usual file formats, with errors that say how to mend the file.

One small module per format, which needs nothing but NumPy (and SciPy for ``.mat``); a format is added
as one more reader in the table of `dcreg.io.points`.
"""

from dcreg.io.pairs import read_candidates, read_matches
from dcreg.io.points import READERS, read_points

__all__ = ["READERS", "read_candidates", "read_matches", "read_points"]
