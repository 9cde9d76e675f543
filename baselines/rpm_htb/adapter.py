"""RPM-HTB, reconstructed: the library's search with the term-wise bounds that DC-Reg replaces."""

from __future__ import annotations

from baselines._shared.library_search import BranchAndBound
from baselines.contract import Instance
from dcreg.bounds import bound_names


class Adapter(BranchAndBound):
    """Same search, box, tolerance, assignment and polish as DC-Reg; only the bound differs."""

    bounds = tuple(name for name in bound_names() if name.startswith("termwise"))
    modes = ("paper",)  # others search with bounds of their own, or differ in more than the bound

    def supports(self, instance: Instance) -> str | None:
        if instance.dim == 3 and "termwise-r3" in self.options["bound"]:
            return f"bound termwise-r3 does not treat {instance.model}"
        return super().supports(instance)
