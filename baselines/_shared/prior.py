"""The entry of `idle_options` for a number of pairs that only chooses among initial poses."""

from __future__ import annotations


def idle_prior(starts: str) -> dict[str, str]:
    """Return that the given number of pairs has no effect, unless there are several initial poses."""
    return {} if starts == "multi" else {"n_inliers_ratio": "with one initial pose"}
