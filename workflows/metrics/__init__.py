"""All quality metrics, computed by the harness from the pose and the ground truth alone.

Every module of this package is imported. A function with the decorator `metric` becomes a column of
``tables/runs``, so a new metric is one file here. Adding one repeats no run. Installed packages add
modules with metrics by the entry points of the group ``dcreg.metrics`` (`dcreg.plugins`).
"""

import sys

from dcreg.plugins import plugins
from workflows.discovery import added_modules, modules
from workflows.metrics.case import METRICS, Case, Metric, metric

GROUP = "dcreg.metrics"  # of entry points

modules(sys.modules[__name__])
# Entry points whose module cannot be used, each with the reason.
BROKEN = added_modules(plugins(GROUP), METRICS)

__all__ = ["BROKEN", "GROUP", "METRICS", "Case", "Metric", "metric"]
