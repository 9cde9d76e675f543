"""Find the archived blocks of an experiment, on which ``--beside`` runs one's own methods."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import product

from baselines import registry
from dcreg.problem import suggestion
from workflows import UserError
from workflows.archives import archived
from workflows.blocks import Needs, Numbers
from workflows.stages.plan import Plan


def needs_beside(plan: Plan, methods: Sequence[str], known: Needs) -> Needs:
    """Return the archived blocks of an experiment, and the same blocks for one's own methods.

    A block counts if all its runs are of the current version of their method, so no archived method runs.

    Parameters
    ----------
    plan : Plan
        Of the whole experiment.
    methods : sequence of str
        One's own.
    known : Needs
        Blocks of earlier calls, which remain needed.

    Raises
    ------
    UserError
        One of `methods` is not in the experiment, or the archives have no block of the experiment.
    """
    names = [method.name for method in plan.methods]
    for name in methods:
        if name not in names:
            raise UserError(
                f"--methods: experiment {plan.experiment.name} has no method "
                f"{name!r}{suggestion(name, names)}, nor does `make baselines` list it"
            )
    needs = known.joined(_archived_blocks(plan, methods))
    if not needs.trials:
        raise UserError(
            f"--beside: no archive has a complete block of experiment {plan.experiment.name} with the "
            "current versions of its methods; run it without --beside"
        )
    for own in list(needs.trials.items()):
        needs = needs.joined(_same_blocks(*own, methods))
    return needs


def _same_blocks(test: str, own: Mapping[str, Numbers], methods: Sequence[str]) -> Needs:
    """Return needs in which these methods have all blocks of a test that some method has."""
    needs = Needs({})
    for numbers, method in product(own.values(), methods):
        needs = needs.joined(Needs({test: {method: numbers}}))
    return needs


def _archived_blocks(plan: Plan, methods: Sequence[str]) -> Needs:
    """Return how many first trials are archived completely, by test, level and other method."""
    stored = {
        method.name: {run_id for run_id, _, version in archived(method.name) if version == present}
        for method in plan.methods
        if method.name not in methods
        for present in [registry.fingerprint(method.baseline, options=method.options)]  # takes long
    }
    missing: dict[tuple[str, str, str], set[int]] = defaultdict(set)
    last: dict[tuple[str, str, str], int] = defaultdict(int)
    for run in plan.runs():
        if (name := run.method.name) in stored:
            key = run.instance.test, name, f"{run.instance.level:g}"
            last[key] = max(last[key], run.instance.trial + 1)
            if run.run_id not in stored[name]:
                missing[key].add(run.instance.trial)
    needs = Needs({})
    for (test, name, level), trials in last.items():
        if count := min(missing[test, name, level], default=trials):
            needs = needs.joined(Needs({test: {name: {level: count}}}))
    return needs
