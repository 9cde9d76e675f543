"""What the server process of `workflows.forking` has loaded when it starts a stage."""

from __future__ import annotations

import scipy.spatial.distance
import scipy.spatial.transform  # noqa: F401

import workflows.__main__
import workflows.stages.aggregate
import workflows.stages.fetch
import workflows.stages.solve  # noqa: F401
from baselines.dependencies import files_behind
from baselines.registry import ROOT

# Every solve job needs the imports of the library, which are kept while the files stay the same.
files_behind(ROOT.glob("dcreg/*.py"), ROOT.parent)
