"""Deep global registration from the authors' checkout, run in the child process."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any


def load(checkout: str, weights: str, settings: dict[str, Any]) -> Callable[[dict[str, Any]], Any]:
    """Load the authors' pipeline as in their demo."""
    import torch
    from core.deep_global_registration import DeepGlobalRegistration

    config = argparse.Namespace(
        weights=weights,
        clip_weight_thresh=settings["clip_weight_thresh"],
        inlier_feature_type=None,  # read from the weights
    )
    pipeline = DeepGlobalRegistration(config, device=torch.device(settings["device"]))
    return lambda problem: pipeline.register(problem["source"], problem["target"])
