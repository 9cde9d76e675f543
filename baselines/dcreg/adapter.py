"""DC-Reg: the library of this repository."""

from baselines._shared.library_search import BranchAndBound


class Adapter(BranchAndBound):
    """Branch and bound with the holistic DC bound."""
