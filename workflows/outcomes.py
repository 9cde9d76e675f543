"""The five groups in which every planned run is counted."""

from __future__ import annotations

import pandas as pd

STARTED = ("finished", "limited", "failed")
OUTCOMES = (*STARTED, "unsupported", "unavailable")


def attempted(runs: pd.DataFrame) -> pd.DataFrame:
    """Runs that were really started: neither unsupported nor unavailable."""
    return runs[runs["outcome"].isin(STARTED)]
