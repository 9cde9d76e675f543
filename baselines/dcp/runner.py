"""DCP from the authors' checkout (``model.py``), run in the child process."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import numpy as np


def load(checkout: str, weights: str, settings: dict[str, Any]) -> Callable[[dict[str, Any]], Any]:
    """Load the network with the layout of its published training; return its registration function."""
    import model
    import torch

    device = torch.device(settings["device"])
    model.torch = OneDevice(torch, device)
    layout = argparse.Namespace(
        emb_nn="dgcnn", pointer=settings["pointer"], head="svd", emb_dims=512, n_blocks=1,
        dropout=0.0, ff_dims=1024, n_heads=4, cycle=False,
    )  # fmt: skip
    network = model.DCP(layout)
    answer = network.load_state_dict(torch.load(weights, map_location=device), strict=False)
    missing = [name for name in answer.missing_keys if not name.endswith("reflect")]
    if missing:
        raise ValueError(
            "weights lack %s and %d more; is option pointer right?" % (missing[0], len(missing) - 1)  # noqa: UP031
        )
    network = network.to(device).eval()

    def register(problem: dict[str, np.ndarray]) -> np.ndarray:
        # The network was trained on shapes of unit radius about the origin.
        source, target = problem["source"], problem["target"]
        centre_x, centre_y = source.mean(axis=0), target.mean(axis=0)
        unit = max(np.linalg.norm(source - centre_x, axis=1).max(), 1e-12)
        clouds = [
            torch.tensor(((points - centre) / unit).T[None], dtype=torch.float32, device=device)
            for points, centre in ((source, centre_x), (target, centre_y))
        ]
        with torch.no_grad():
            rotation, translation = (part[0].cpu().numpy() for part in network(*clouds)[:2])
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = unit * translation + centre_y - rotation @ centre_x
        return pose

    return register


class OneDevice:
    """Replacement of ``torch`` for a module that always requests the device ``cuda``."""

    def __init__(self, torch: Any, device: Any) -> None:
        self._torch = torch
        self._device = device

    def device(self, name: str) -> Any:
        return self._device

    def __getattr__(self, name: str) -> Any:
        return getattr(self._torch, name)
