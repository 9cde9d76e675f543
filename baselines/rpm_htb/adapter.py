"""RPM-HTB, reconstructed: the library's search with the term-wise bounds that DC-Reg replaces."""

from __future__ import annotations

from baselines._shared.library_search import BranchAndBound
from baselines.contract import Instance
from dcreg.names import bound_names


class Adapter(BranchAndBound):
    """Search, box, tolerance, assignment and polish of DC-Reg in mode `paper`; only the bound differs."""

    bounds = tuple(name for name in bound_names() if name.startswith("termwise"))
    mode = "paper"  # the others search with bounds of their own, or differ in more than the bound

    def supports(self, instance: Instance) -> str | None:
        if instance.dim == 3 and "termwise-r3" in self.options["bound"]:
            return f"bound termwise-r3 does not treat {instance.model}"
        return super().supports(instance)
