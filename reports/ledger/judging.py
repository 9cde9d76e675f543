"""Judge claims by the available tables."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, fields
from typing import Any

import pandas as pd
from markupsafe import Markup

from reports.ledger import planned
from reports.ledger.book import UNJUDGED as KINDS
from reports.ledger.book import Claim, Ledger, ledger
from reports.ledger.drawing import strips
from reports.ledger.evidence import STUDY, Evidence, Experiment
from reports.ledger.finding import Finding, Parameters, Source, find, second
from reports.ledger.intervals import NOT, NOT_RUN, OPEN, REPRODUCED, VERDICTS
from reports.ledger.verdicts import Row, decide, of_all, of_any, rows
from reports.tables import limits_of
from reports.theme import words

__all__ = ["Judgement", "Ledger", "as_table", "count", "judge", "judge_claim", "ledger"]

NO_VERDICT = "no verdict"
STAGED = ("dcreg", "dcreg_paper")  # methods with a stage that `Claim.reconstruction` names
# Columns of the runs behind a verdict, as offered for download.
DATA = [
    "run_id", "instance_id", "experiment", "method", "display_name", "baseline", "options_effective",
    "n_inliers_ratio", "dataset", "shape", "test", "level", "trial", "n_inliers", "status", "outcome",
    "success", "rmse", "rmse_floor", "error", "excess", "objective", "objective_best", "lower_bound",
    "upper_bound", "gap_tol", "certified", "verdict", "violation", "missed", "time_solve_s", "n_nodes",
    "n_assignments", "machine_id",
]  # fmt: skip


@dataclass(frozen=True)
class Judgement:
    """A verdict with the rows behind it, the reason, and the command that makes the tables."""

    id: str
    verdict: str
    quote: str
    test: str
    evidence: str
    reason: str
    tested: str  # what was and what was not tested
    reconstruction: str  # reconstructed methods that the verdict relies on
    runs: int  # of the deciding rows
    limited: int
    command: str
    note: str
    unjudged: str
    because: str
    rows: tuple[Row, ...]
    data: pd.DataFrame  # the runs, or boxes, behind the verdict

    @property
    def kind(self) -> str:
        """Why the claim has no verdict; empty if it has one."""
        return KINDS.get(self.unjudged, "")

    @property
    def tables(self) -> list[tuple[str, list[tuple[Row, Markup]]]]:
        """The figure of evidence: rows with their strips, by what the figures are."""
        grouped: dict[str, list[Row]] = {}
        for row in self.rows:
            grouped.setdefault(row.figure, []).append(row)
        return [
            (figure, list(zip(rows, strips(rows), strict=True))) for figure, rows in grouped.items()
        ]


def judge(book: Ledger, evidence: Evidence, experiments: set[str] | None = None) -> list[Judgement]:
    """Return the verdict of every claim, or of those about `experiments`."""
    return [
        judge_claim(book, claim, evidence)
        for claim in book.claims
        if experiments is None or claim.experiment in experiments
    ]


def judge_claim(book: Ledger, claim: Claim, evidence: Evidence) -> Judgement:
    """Return the verdict of one claim."""
    experiment = evidence.experiments.get(claim.experiment)
    findings: list[Finding] = []
    found: list[list[Row]] = []
    if (claim.experiment == STUDY and evidence.study) or experiment is not None:
        design = _design(book, experiment)
        select = design.select if design else None
        source = Source(evidence, experiment, book.roles, book.axes, select)
        findings = [_find(source, entry, design) for entry in claim.checks]
        quick = experiment is not None and experiment.is_quick
        decided = decide(findings, quick=quick, missing=sum(each.absent for each in findings))
        found = [
            rows(finding, own, at, *second(source, entry))
            for at, (finding, own, entry) in enumerate(
                zip(findings, decided, claim.checks, strict=True)
            )
        ]
    verdict, reason = _verdict(claim, findings, found)
    every = [row for each in found for row in each]
    deciding = [
        row for row in every if not row.shown_only and (verdict != NOT or row.verdict == NOT)
    ]
    runs = {run: late for row in deciding for run, late in row.runs.items()}
    limited = sum(runs.values())
    if runs and experiment is not None:
        reason += f". {_limits(experiment, runs)}"
    command = book.commands[claim.experiment]
    if experiment is not None and experiment.tables.is_of_blocks:
        command = f"make evidence EXPERIMENTS={experiment.tables.experiment}"
        reason += f"; run more blocks: {command}" if verdict == NOT_RUN else ""
    elif verdict == NOT_RUN:
        is_part = experiment is not None and bool(experiment.variables)
        reason += f"; run the {'whole ' * is_part}experiment: {command}"
    elif experiment is not None:
        command += experiment.variables
    return Judgement(
        id=claim.id,
        verdict=NO_VERDICT if claim.unjudged else verdict,
        quote=claim.quote,
        test=claim.test,
        evidence=_evidence(deciding, verdict),
        reason=reason,
        tested=_tested(book, claim, experiment, findings, every),
        reconstruction=_reconstructed(claim, deciding, experiment),
        runs=len(runs),
        limited=limited,
        command=command,
        note=claim.note,
        unjudged=claim.unjudged,
        because=claim.because,
        rows=tuple(every),
        data=_data(findings, every, experiment),
    )


def _design(book: Ledger, experiment: Experiment | None) -> planned.Design | None:
    """Return what the claims compare in an experiment of blocks; None for others."""
    if experiment is None or not experiment.tables.is_of_blocks:
        return None
    datasets = (experiment.tables.provenance.get("config") or {}).get("datasets") or []
    if not datasets or not all(entry.get("shapes") for entry in datasets):
        return None
    first = planned.first_block(datasets)
    return planned.Design(first, book.axes, lambda name: experiment.planned_in(book.roles[name]))


def _find(source: Source, entry: Parameters, design: planned.Design | None) -> Finding:
    """Run a check, and count the planned comparisons that have no value."""
    finding = find(source, entry)
    if design is None or entry.get("shown_only"):
        return finding
    figures = design.figures(entry)
    finding.absent = planned.missing(figures, finding.parts)
    if finding.absent and (finding.parts or not finding.missing):
        every = sum(each.number for each in figures)
        finding.miss(f"{finding.absent} of {every} planned comparisons")
    return finding


def count(judgements: list[Judgement]) -> list[tuple[str, int]]:
    """Count the claims per verdict, those without a verdict last."""
    counts = Counter(judgement.verdict for judgement in judgements)
    return [
        (verdict, counts[verdict])
        for verdict in (*VERDICTS, NO_VERDICT)
        if verdict != NO_VERDICT or counts[NO_VERDICT]
    ]


def as_table(judgements: list[Judgement]) -> pd.DataFrame:
    """Return a table with a row per claim."""
    columns = [field.name for field in fields(Judgement) if field.name not in ("rows", "data")]
    return pd.DataFrame(
        [{name: getattr(found, name) for name in columns} for found in judgements], columns=columns
    )


def comparisons(judgements: list[Judgement]) -> pd.DataFrame:
    """Return a table with a row per comparison, with its figure, interval and decision."""
    table = []
    for found in judgements:
        for row in found.rows:
            for each in row.decided:
                (side, threshold), (low, high) = *each.part.claimed.items(), each.interval
                table.append(
                    {
                        "claim": found.id, "figure": row.figure, "subject": row.subject,
                        "rival": row.rival, "group": row.group, "where": each.part.where,
                        "verdict": each.verdict, "value": each.part.estimate.value, "low": low,
                        "high": high, "coverage": 1 - each.level, "side": side,
                        "threshold": threshold, "trials": each.part.estimate.n,
                        "instances": each.part.instances,
                        "runs": len(each.part.runs), "limited": sum(each.part.runs.values()),
                        "shown_only": row.shown_only, "open_because": each.why,
                    }
                )  # fmt: skip
    return pd.DataFrame(table)


def _verdict(claim: Claim, findings: list[Finding], found: list[list[Row]]) -> tuple[str, str]:
    if not findings:
        return NOT_RUN, f"no tables of {claim.experiment}"
    deciding = [
        (finding, [row for row in each if not row.shown_only])
        for finding, each, entry in zip(findings, found, claim.checks, strict=True)
        if not entry.get("shown_only")
    ]
    every = [row for _, each in deciding for row in each]
    joint = [_joint(finding, each) for finding, each in deciding]
    # one value that agrees is enough for a check with `any`
    missing = list(dict.fromkeys(
        name for (finding, _), verdict in zip(deciding, joint, strict=True)
        if not (finding.of_any and verdict == REPRODUCED) for name in finding.missing
    ))  # fmt: skip
    if not every and claim.unjudged and any(found):
        return NOT_RUN, ""  # all values are shown only
    if not every:
        lacking = missing or list(dict.fromkeys(f.figure for f in findings))
        return NOT_RUN, f"not in the tables: {'; '.join(lacking)}"
    verdict = of_all(each for each in joint if each)
    reason = _counted(every)
    lacking = [f.figure for f, each in deciding if not each]
    if verdict == REPRODUCED and (missing or lacking):
        what = ", ".join(missing or lacking)
        return OPEN, f"the available part agrees with the claim; not in the tables: {what}"
    if missing:
        reason += f"; not in the tables: {', '.join(missing)}"
    return verdict, reason


def _joint(finding: Finding, own: list[Row]) -> str:
    """Return the joint verdict of a check; empty without a value.

    If any value is enough, those that are still missing could reproduce it.
    """
    if not own:
        return ""
    verdict = (of_any if finding.of_any else of_all)(row.verdict for row in own)
    return OPEN if finding.of_any and verdict == NOT and finding.absent else verdict


def _counted(every: list[Row]) -> str:
    """Count the rows per verdict, and state what the open ones need."""
    counts = Counter(row.verdict for row in every)
    if len(every) == 1:
        (row,) = every
        texts = {
            REPRODUCED: "value and interval lie on the claimed side",
            NOT: "value and interval lie on the other side",
            OPEN: row.open_because,
        }
        return texts[row.verdict]
    shown = [f"{counts[name]} {name}" for name in (REPRODUCED, NOT, OPEN) if counts[name]]
    text = f"{len(every)} comparisons with a rival or threshold: {', '.join(shown)}"
    needs = list(dict.fromkeys(row.open_because for row in every if row.open_because))
    return text + (f" ({needs[0]}{'; others: see the table' * (len(needs) > 1)})" if needs else "")


def _limits(experiment: Experiment, runs: dict[str, bool]) -> str:
    """Return how many of the deciding runs hit which limits; `runs` tells for each whether it did."""
    limited = sum(runs.values())
    late = experiment.with_ids(run for run, is_late in runs.items() if is_late)
    hit = late.drop_duplicates(["method", "status"])[["method", "status"]].itertuples(index=False)
    cards = experiment.tables.cards
    texts = dict.fromkeys(
        text for name, status in hit if (text := limits_of(cards.get(name, {})).get(status))
    )
    stated = f" ({', '.join(texts)})" if texts else ""
    share = f"{limited} of {len(runs)} deciding runs"
    share = share if limited else f"None of the {len(runs)} deciding runs"
    return f"{share} hit a limit{stated}"


def _evidence(deciding: list[Row], verdict: str) -> str:
    """Return the figure of each check that is farthest from the claimed side."""
    texts: dict[str, str] = {}
    for row in sorted(deciding, key=lambda row: row.shown.margin):
        if row.verdict == verdict:
            where = ", ".join(filter(None, (row.names, row.group, row.shown.part.where)))
            texts.setdefault(row.figure, f"{row.figure} {row.value} ({where})")
    return "; ".join(texts.values())


def _tested(
    book: Ledger,
    claim: Claim,
    experiment: Experiment | None,
    findings: list[Finding],
    every: list[Row],
) -> str:
    """State in one sentence what was tested and what was not."""
    missing = list(dict.fromkeys(name for finding in findings for name in finding.missing))
    outside = [*missing, *filter(None, (claim.untested, book.untested.get(claim.experiment, "")))]
    without = "; ".join(outside)
    if not every:
        return "Nothing was tested." + (f" Never covered: {without}." if without else "")
    subjects = _listed(row.subject for row in every)
    rivals = _listed(row.rival for row in every if row.rival)
    text = subjects + (f" against {rivals}" if rivals else "")
    if experiment is not None:
        part = experiment.with_ids({run for row in every for run in row.runs})
        sizes = part[["n_source", "n_target"]].to_numpy()
        shapes = part["shape"].unique()
        named = ", ".join(map(str, shapes)) if len(shapes) <= 4 else f"{len(shapes)} shapes"
        tests = ", ".join(words(str(test)) for test in part["test"].unique())
        least, most = int(sizes.min()), int(sizes.max())
        points = f"{least} to {most} points" if most > least else f"{most} points"
        text += f" on {named} ({points}) in {tests}, {part['instance_id'].nunique()} instances"
        text += _machine(experiment, part) if _is_timed(claim) else ""
    return f"Tested: {text}{'; not tested: ' + without if without else ''}."


def _machine(experiment: Experiment, part: pd.DataFrame) -> str:
    """Return machine and languages of a comparison of times."""
    card = experiment.tables.provenance.get("machine", {})
    cpu = card.get("cpu", "an unknown machine")
    if experiment.machine_id != card.get("machine_id", experiment.machine_id):
        cpu = f"machine {experiment.machine_id}"
    names = part.drop_duplicates("method").set_index("method")["display_name"]
    languages = [
        f"{name}: {language}"
        for method, name in names.items()
        if (language := experiment.tables.cards.get(str(method), {}).get("language"))
    ]
    return f", on {cpu}" + (f" ({', '.join(languages)})" if languages else "")


def _is_timed(claim: Claim) -> bool:
    return any(
        {"time", "translation_time"} & {entry.get("quantity"), *entry.get("quantities", ())}
        or entry["kind"] == "race"
        for entry in claim.checks
    )


def _listed(names: Any) -> str:
    return ", ".join(dict.fromkeys(names))


def _reconstructed(claim: Claim, deciding: list[Row], experiment: Experiment | None) -> str:
    """Name the reconstructions behind the deciding rows."""
    if experiment is None:
        return claim.reconstruction if deciding else ""
    names = dict.fromkeys(name for row in deciding for d in row.decided for name in d.part.methods)
    used = [experiment.tables.cards.get(name, {}) | {"method": name} for name in names]
    is_staged = any(card.get("baseline") in STAGED for card in used)
    found = [claim.reconstruction] if claim.reconstruction and is_staged else []
    found += [
        card.get("display_name", card["method"])
        for card in used
        if card.get("provenance") == "reconstruction"
    ]
    return ", ".join(dict.fromkeys(found))


def _data(findings: list[Finding], every: list[Row], experiment: Experiment | None) -> pd.DataFrame:
    """Return the rows of the tables that the comparisons are based on."""
    if experiment is None:
        tables = [table for finding in findings for table in finding.rows]
        return pd.concat(tables).drop_duplicates() if tables else pd.DataFrame()
    runs = experiment.with_ids({run for row in every for run in row.runs})
    return runs[[name for name in DATA if name in runs]]
