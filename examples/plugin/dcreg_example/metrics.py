"""The median error of the true pairs."""

from __future__ import annotations

import numpy as np

from workflows.metrics.case import Case, metric


@metric("target unit", "lower", np.inf)
def example_median_error(case: Case) -> float:
    """Median distance of the true pairs at the found pose."""
    return float(np.median(case.residuals))
