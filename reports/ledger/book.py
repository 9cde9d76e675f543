"""The ledger as a file: claims, roles, commands and facts of ``claims.yaml``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from reports.ledger import checks, checks_study, checks_work  # noqa: F401 (register the kinds)
from reports.ledger.evidence import Role
from reports.ledger.finding import CHECKS
from reports.tables import ReportError

LEDGER = Path(__file__).parents[1] / "claims.yaml"
UNJUDGED = {
    "proof": "the statement is proven, not measured",
    "data": "the data are not available, so a substitute is measured",
}
_ROLES = ("subject", "reference", "methods", "rivals", "rival")


@dataclass(frozen=True)
class Claim:
    """One claim of the paper, and how this project checks it."""

    id: str
    quote: str
    test: str  # the check in words; its threshold is this project's
    experiment: str
    checks: tuple[dict[str, Any], ...]
    note: str = ""
    reconstruction: str = ""  # in addition to the cards of the deciding methods
    unjudged: str = ""  # one of `UNJUDGED`: the claim has no verdict
    because: str = ""  # why it has no verdict
    untested: str = ""  # in addition to what the experiment does not test


@dataclass(frozen=True)
class Ledger:
    claims: tuple[Claim, ...]
    roles: Mapping[str, Role]
    axes: Mapping[str, float]  # test -> highest level in the paper
    commands: Mapping[str, str]
    untested: Mapping[str, str]  # experiment -> what it cannot test
    facts: tuple[str, ...]

    @classmethod
    def read(cls, path: Path = LEDGER) -> Ledger:
        """Read the ledger; raise ReportError for a claim that names an unknown check, role or command."""
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        roles = {name: Role(name, **role) for name, role in content["roles"].items()}
        claims = tuple(
            Claim(**{**entry, "checks": tuple(entry["checks"])}) for entry in content["claims"]
        )
        ledger = cls(
            claims, roles, content["axes"], content["commands"], content["untested"],
            tuple(content["facts"]),
        )  # fmt: skip
        for claim in claims:
            ledger._check(claim, path)
        return ledger

    def _check(self, claim: Claim, path: Path) -> None:
        for entry in claim.checks:
            if entry.get("kind") not in CHECKS:
                raise ReportError(
                    f"{path}: {claim.id}: no check {entry.get('kind')!r}; known: {', '.join(CHECKS)}"
                )
            for role in roles_of(entry):
                if role not in self.roles:
                    raise ReportError(f"{path}: {claim.id}: no role {role!r}; add it to roles")
        if claim.experiment not in self.commands:
            raise ReportError(
                f"{path}: {claim.id}: no command makes {claim.experiment!r}; add it to commands"
            )
        if claim.unjudged and claim.unjudged not in UNJUDGED:
            raise ReportError(
                f"{path}: {claim.id}: unjudged is {claim.unjudged!r}; give one of {', '.join(UNJUDGED)}"
            )


def roles_of(entry: Mapping[str, Any]) -> Iterator[str]:
    """Yield the roles that a check over runs names."""
    if CHECKS[entry["kind"]].of_study:
        return
    for names in (entry.get(key, []) for key in _ROLES):
        yield from [names] if isinstance(names, str) else names


@cache
def ledger() -> Ledger:
    """Return the ledger of this project."""
    return Ledger.read()
