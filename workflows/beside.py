"""Find the archived blocks of an experiment, on which ``--beside`` runs one's own methods."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

from baselines import registry
from dcreg.problem import suggestion
from workflows import UserError
from workflows.archives import archived
from workflows.blocks import Needs
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
    trials = {test: dict(own) for test, own in known.trials.items()}
    for (test, method), count in _archived_blocks(plan, methods).items():
        own = trials.setdefault(test, {})
        own[method] = max(own.get(method, 0), count)
    if not trials:
        raise UserError(
            f"--beside: no archive has a complete block of experiment {plan.experiment.name} with the "
            "current versions of its methods; run it without --beside"
        )
    needs = Needs(trials)
    return Needs({
        test: {**own, **dict.fromkeys(methods, needs.blocks(test))} for test, own in trials.items()
    })  # fmt: skip


def _archived_blocks(plan: Plan, methods: Sequence[str]) -> dict[tuple[str, str], int]:
    """Return how many first trials of a test are archived completely, by test and other method."""
    stored = {
        method.name: {
            run_id
            for run_id, _, version in archived(method.name)
            if version == registry.fingerprint(method.baseline)
        }
        for method in plan.methods
        if method.name not in methods
    }
    missing: dict[tuple[str, str], set[int]] = defaultdict(set)
    last: dict[tuple[str, str], int] = defaultdict(int)
    for run in plan.runs():
        if (name := run.method.name) in stored:
            key = run.instance.test, name
            last[key] = max(last[key], run.instance.trial + 1)
            if run.run_id not in stored[name]:
                missing[key].add(run.instance.trial)
    found = {key: min(missing[key], default=trials) for key, trials in last.items()}
    return {key: count for key, count in found.items() if count}
