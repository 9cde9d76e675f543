"""Term-wise bilinear branch and bound: the library's search with the relaxation DC-Reg replaces."""

from baselines._search import BranchAndBound


class Adapter(BranchAndBound):
    """Same search, box, tolerance and polish as DC-Reg; only the bound differs."""

    bounds = ("termwise", "termwise-r1", "termwise-r2")
