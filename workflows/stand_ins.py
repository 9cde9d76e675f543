"""What to run instead where public data cannot be fetched: other datasets, or embedded shapes."""

from __future__ import annotations

from data import registry
from data.fetch import UnavailableError
from workflows import UserError, archives
from workflows.compose import EMBEDDED, QUICK
from workflows.embedded import dims_of
from workflows.stages.commands import planned
from workflows.stages.plan import Plan


def fetchable(experiment: str, select: list[str]) -> tuple[str, list[str], Plan]:
    """Return an experiment, a selection and their plan, without data that cannot be fetched here.

    Raises
    ------
    UserError
        Nothing can be run.
    """
    plan = planned(experiment, select)
    if missing := unreachable(plan):
        experiment, others = instead_of(plan, missing)
        select = [part for part in select if not part.startswith(("datasets=", "shapes="))]
        select += [f"datasets={','.join(others)}"] if others else []
        plan = planned(experiment, select)
    return experiment, select, plan


def unreachable(plan: Plan) -> dict[str, str]:
    """Return the datasets of a plan whose files cannot be fetched, each with the reason.

    The first instance of each dataset is tried.
    """
    first = {spec.dataset: spec for chunk in plan.chunks for spec in reversed(chunk.instances)}
    found = {}
    for name, spec in first.items():
        dataset = registry.dataset(name)
        if not dataset.card.files:
            continue
        try:
            dataset.fetch(spec.shape, spec.test, spec.level, spec.trial)
        except UnavailableError as error:
            found[name] = str(error)
    return found


def instead_of(plan: Plan, missing: dict[str, str]) -> tuple[str, list[str]]:
    """Return the experiment and the datasets to run without the missing ones, and print what is left out.

    Raises
    ------
    UserError
        Nothing can be run, or only a long experiment on other shapes.
    """
    for name, reason in missing.items():
        print(f"left out  {name}: {reason}")
    for folder in archives.folders()[-1:]:
        held = ", ".join(archives.facts(folder).get("experiments", {}))
        print(f"archive   stored runs of {held}: make report ARCHIVE={folder.name}")
    present = {spec.dataset for chunk in plan.chunks for spec in chunk.instances} - set(missing)
    if present:
        print(f"instead   only {', '.join(sorted(present))}", flush=True)
        return plan.config, sorted(present)
    has_shapes = any(list(dims_of(entry.model_dump())) for entry in plan.experiment.datasets)
    stand_in = f"{plan.config}{EMBEDDED}"
    if not has_shapes or not plan.config.endswith(QUICK):
        remedy = f"; on embedded shapes: make run CONFIG={stand_in}" if has_shapes else ""
        raise UserError(
            f"experiment {plan.experiment.name}: none of its data can be fetched here{remedy}"
        )
    print(
        f"instead   the same tests on embedded shapes ({stand_in}); these results do not replace "
        "those on the data left out",
        flush=True,
    )
    return stand_in, []
