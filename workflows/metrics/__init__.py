"""All quality metrics, computed by the harness from the pose and the ground truth alone.

Every module of this package is imported. A function with the decorator `metric` becomes a column of
``tables/runs``, so a new metric is one file here. Adding one repeats no run.
"""

import sys

from workflows.discovery import modules
from workflows.metrics.case import METRICS, Case, Metric, metric

modules(sys.modules[__name__])

__all__ = ["METRICS", "Case", "Metric", "metric"]
