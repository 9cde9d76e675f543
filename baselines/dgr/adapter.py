"""DGR, deep global registration, from the user's checkout."""

from __future__ import annotations

from pathlib import Path

from baselines._shared.learned import LearnedMethod


class Adapter(LearnedMethod):
    """Clouds are not rescaled: the weights fix the voxel size in metres."""

    folder = Path(__file__).parent
    expects = ("core/deep_global_registration.py",)
