"""From claims and tables to verdicts."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from reports.ledger import checks  # noqa: F401 (registers the kinds)
from reports.ledger.evidence import STUDY, Evidence, Experiment, Role
from reports.ledger.finding import (
    CHECKS,
    LIMITED,
    SETTLED,
    STUDY_CHECKS,
    Finding,
    Part,
    Source,
    found,
)
from reports.ledger.intervals import MIN_INSTANCES, NOT, NOT_RUN, OPEN, REPRODUCED, VERDICTS
from reports.tables import ReportError

LEDGER = Path(__file__).parents[1] / "claims.yaml"


@dataclass(frozen=True)
class Claim:
    """One claim of the paper, and how this project checks it."""

    id: str
    quote: str
    test: str  # the check in words; its threshold is this project's
    experiment: str
    checks: tuple[dict[str, Any], ...]
    note: str = ""
    limits_decide: bool = False  # the claim is about runs at their limit
    reconstruction: str = ""  # in addition to the cards of the deciding methods


@dataclass(frozen=True)
class Judgement:
    """A verdict with the deciding figure, the reason, and the command that makes the tables."""

    id: str
    verdict: str
    quote: str
    test: str
    evidence: str
    reason: str
    reconstruction: str  # reconstructed methods that the verdict relies on
    runs: int
    limited: int
    command: str
    note: str


@dataclass(frozen=True)
class Ledger:
    claims: tuple[Claim, ...]
    roles: dict[str, Role]
    axes: dict[str, float]  # test -> highest level in the paper
    commands: dict[str, str]
    facts: tuple[str, ...]

    @classmethod
    def read(cls, path: Path = LEDGER) -> Ledger:
        """Read the ledger; raise ReportError for a claim that names an unknown check, role or command."""
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        roles = {name: Role(name, **role) for name, role in content["roles"].items()}
        claims = tuple(
            Claim(**{**entry, "checks": tuple(entry["checks"])}) for entry in content["claims"]
        )
        ledger = cls(claims, roles, content["axes"], content["commands"], tuple(content["facts"]))
        for claim in claims:
            ledger._check(claim, path)
        return ledger

    def _check(self, claim: Claim, path: Path) -> None:
        for entry in claim.checks:
            if entry.get("kind") not in CHECKS:
                raise ReportError(
                    f"{path}: {claim.id}: no check {entry.get('kind')!r}; known: {', '.join(CHECKS)}"
                )
            if entry["kind"] in STUDY_CHECKS:
                continue
            named = [entry.get(key, []) for key in ("subject", "reference", "methods", "rivals")]
            for role in (
                r for names in named for r in ([names] if isinstance(names, str) else names)
            ):
                if role not in self.roles:
                    raise ReportError(f"{path}: {claim.id}: no role {role!r}; add it to roles")
        if claim.experiment not in self.commands:
            raise ReportError(
                f"{path}: {claim.id}: no command makes {claim.experiment!r}; add it to commands"
            )


@cache
def ledger() -> Ledger:
    """Return the ledger of this project."""
    return Ledger.read()


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
    if (claim.experiment == STUDY and evidence.study) or experiment is not None:
        source = Source(evidence, experiment, book.roles, book.axes)
        findings = [
            found(source, entry, limits_decide=claim.limits_decide) for entry in claim.checks
        ]
    runs = {run: outcome for finding in findings for run, outcome in finding.runs.items()}
    limited = sum(outcome in (LIMITED, SETTLED) for outcome in runs.values())
    verdict, reason = _verdict(claim, findings)
    command = book.commands[claim.experiment]
    quick = experiment is not None and experiment.is_quick
    if verdict == NOT_RUN:
        reason += f"; {'run the whole experiment' if quick else 'make the tables'} with {command}"
    elif quick:
        command += " QUICK=1"
    return Judgement(
        id=claim.id,
        verdict=verdict,
        quote=claim.quote,
        test=claim.test,
        evidence=_shown(findings, verdict),
        reason=reason,
        reconstruction=_reconstructed(claim, findings, experiment),
        runs=len(runs),
        limited=limited,
        command=command,
        note=claim.note,
    )


def count(judgements: list[Judgement]) -> list[tuple[str, int]]:
    """Count the claims per verdict."""
    counts = Counter(judgement.verdict for judgement in judgements)
    return [(verdict, counts[verdict]) for verdict in VERDICTS]


def as_table(judgements: list[Judgement]) -> pd.DataFrame:
    """Return a table with a row per claim."""
    return pd.DataFrame([asdict(judgement) for judgement in judgements])


def _verdict(claim: Claim, findings: list[Finding]) -> tuple[str, str]:
    parts = [part for finding in findings for part in finding.parts]
    missing = list(dict.fromkeys(name for finding in findings for name in finding.missing))
    if not findings:
        return NOT_RUN, f"no tables of {claim.experiment}"
    if not parts:
        lacking = missing or list(dict.fromkeys(f.figure for f in findings))
        return NOT_RUN, f"not in the tables: {'; '.join(lacking)}"
    verdict, reason = _of_parts(parts)
    lacking = [f.figure for f in findings if not f.parts]
    if verdict == REPRODUCED and (missing or lacking):
        what = ", ".join(missing or lacking)
        return OPEN, f"the available part agrees with the claim; not in the tables: {what}"
    if missing:
        reason += f"; not in the tables: {', '.join(missing)}"
    return verdict, reason


def _of_parts(parts: list[Part]) -> tuple[str, str]:
    """All parts must be on the claimed side; a single part on the other side refutes the claim."""
    count = {name: sum(p.verdict == name for p in parts) for name in (REPRODUCED, NOT, OPEN)}
    verdict = NOT if count[NOT] else OPEN if count[OPEN] else REPRODUCED
    if len(parts) == 1:
        n = parts[0].interval.n
        texts = {
            REPRODUCED: "the interval lies on the claimed side",
            NOT: "the interval lies on the other side",
            OPEN: "runs at a limit could change the verdict"
            if parts[0].depends
            else f"the interval overlaps both sides (n = {n})",
        }
        return verdict, texts[verdict]
    shown = [
        f"{count[name]} {text}"
        for name, text in (
            (REPRODUCED, "as claimed"),
            (NOT, "against the claim"),
            (OPEN, "inconclusive"),
        )
        if count[name]
    ]
    few = sum(p.verdict == OPEN and p.interval.n < MIN_INSTANCES for p in parts)
    depends = sum(p.depends for p in parts)
    why = [
        f"{number} {text}"
        for number, text in (
            (depends, "because of runs at a limit that could change them"),
            (few, f"with fewer than {MIN_INSTANCES} instances"),
        )
        if number
    ]
    shown[-1] += f" ({', '.join(why)})" if why else ""
    return verdict, f"of {len(parts)} comparisons {', '.join(shown)}"


def _shown(findings: list[Finding], verdict: str) -> str:
    """Return the deciding figure of each check: the one farthest from the claimed side."""
    texts = []
    for finding in findings:
        parts = [p for p in finding.parts if p.verdict == verdict] or finding.parts
        if parts:
            part = min(parts, key=lambda p: p.margin)
            count = (
                f", the least favourable of {len(finding.parts)}" if len(finding.parts) > 1 else ""
            )
            texts.append(f"{finding.figure} {part.interval} ({part.where}{count})")
    return "; ".join(texts)


def _reconstructed(claim: Claim, findings: list[Finding], experiment: Experiment | None) -> str:
    names = [claim.reconstruction] if claim.reconstruction and findings else []
    if experiment is not None:
        cards = experiment.tables.cards
        used = dict.fromkeys(method for finding in findings for method in finding.methods)
        names += [
            cards[method].get("display_name", method)
            for method in used
            if cards.get(method, {}).get("provenance") == "reconstruction"
        ]
    return ", ".join(names)
