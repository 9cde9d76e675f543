"""Compare both scores of `register_matches` on the official lists of scans, pair by pair.

``python -m workflows.studies.surface_score OUT`` registers every fourth pair of 3DMatch and of 3DLoMatch
from the five nearest matches per point, once with each score. It writes ``pairs.csv``, a row per pair,
and ``summary.csv``, a row per list: the successes of each score, the pairs that only one of them
registers, and an interval of the difference of success rates. An interrupted run continues with the
missing pairs. ``--every 8`` and ``--every 8 --first 4`` divide the pairs into two halves.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import pandas as pd
import typer
from scipy.stats import binomtest

import dcreg
from baselines._shared.front_ends import shared_matches
from data.contract import RawInstance
from data.registry import dataset
from data.threedmatch.loader import LISTS, Loader
from dcreg.files import whole_file
from workflows.metrics import Case
from workflows.metrics.errors import rotation_error_deg, translation_error
from workflows.studies.threedmatch import MAX_ROTATION_DEG, MAX_TRANSLATION

MATCHES = "shared-several"
OLD, NEW = "correspondences", "surfaces"  # NEW is compared with OLD
COVERAGE = 0.95


def main(
    out: Annotated[Path, typer.Argument(help="folder for the tables")],
    every: Annotated[int, typer.Option(help="step between the pairs of a list")] = 4,
    first: Annotated[int, typer.Option(help="position of the first pair")] = 0,
) -> None:
    """Register the pairs that ``pairs.csv`` lacks; print and store the tables."""
    out.mkdir(parents=True, exist_ok=True)
    table = out / "pairs.csv"
    rows: list[Mapping[Any, object]] = []
    if table.is_file():
        rows += pd.read_csv(table).to_dict("records")
    known = {(row["list"], row["position"]) for row in rows}
    loader = dataset("threedmatch")
    assert isinstance(loader, Loader)
    for name in LISTS:
        keys = [key for key in loader.pairs if key[1] == name]
        for position in range(first, len(keys), every):
            if (name, position) not in known:
                raw = loader.load(*keys[position], None)
                rows.append({"list": name, "position": position, **compared(raw)})
                _write(pd.DataFrame(rows), table)
    pairs = pd.DataFrame(rows)
    summary = paired(pairs)
    _write(summary, out / "summary.csv")
    print(summary.to_string(index=False))
    print(f"tables: {out}")


def compared(raw: RawInstance) -> dict[str, object]:
    """Register a pair of scans with each score; return the row of the pair."""
    assert raw.match_radii is not None
    assert raw.noise_bound is not None
    matches = shared_matches(raw.source, raw.target, raw.match_radii)[MATCHES]
    row: dict[str, object] = {
        "ref": raw.info["ref"], "src": raw.info["src"], "overlap": raw.info["overlap"],
        "n_source": len(raw.source), "n_target": len(raw.target), "n_matches": len(matches),
    }  # fmt: skip
    for score in (OLD, NEW):
        began = time.perf_counter()
        found = dcreg.register_matches(
            raw.source, raw.target, matches, inlier_distance=raw.noise_bound, score=score,
            certify=False,
        )  # fmt: skip
        case = Case(
            found.T_target_source, raw.T_true, raw.source, raw.target, raw.pairs, len(raw.pairs),
            (1.0, 1.0),
        )  # fmt: skip
        turn, shift = rotation_error_deg(case), translation_error(case)
        values = {
            "right": turn < MAX_ROTATION_DEG and shift < MAX_TRANSLATION,
            "rotation_error_deg": round(turn, 3),
            "translation_error": round(shift, 4),
            "n_agreeing": found.n_inliers,
            "n_warnings": len(found.warnings),
            "time_s": round(time.perf_counter() - began, 2),
        }
        row |= {f"{score}_{key}": value for key, value in values.items()}
    return row


def paired(pairs: pd.DataFrame) -> pd.DataFrame:
    """Return a row per list: successes, pairs that only one score registers, and the difference."""
    rows = []
    for name, group in pairs.groupby("list", sort=False):
        old, new = (group[f"{score}_right"].astype(bool) for score in (OLD, NEW))
        gained, lost = int((new & ~old).sum()), int((old & ~new).sum())
        rows.append(
            {
                "list": name, "pairs": len(group), f"{OLD}_right": int(old.sum()),
                f"{NEW}_right": int(new.sum()), "gained": gained, "lost": lost,
                **difference(gained, lost, len(group))._asdict(),
                f"{OLD}_median_s": group[f"{OLD}_time_s"].median(),
                f"{NEW}_median_s": group[f"{NEW}_time_s"].median(),
            }
        )  # fmt: skip
    return pd.DataFrame(rows)


class Difference(NamedTuple):
    """The difference of two paired success rates in percentage points, its interval and p-value."""

    difference: float
    low: float
    high: float
    p_value: float


def difference(gained: int, lost: int, n: int) -> Difference:
    """Return the difference of paired success rates with its exact conditional interval.

    Given the number of pairs that exactly one score registers, the number of gained pairs is binomial.
    The p-value is that of McNemar's exact test. The interval is Clopper and Pearson's interval of the
    gained share, converted to a difference in percentage points.
    """
    apart = gained + lost
    if not apart:
        return Difference(0.0, 0.0, 0.0, 1.0)
    test = binomtest(gained, apart)
    ends = test.proportion_ci(COVERAGE)
    low, high = (round(100 * (2 * end - 1) * apart / n, 2) for end in (ends.low, ends.high))
    return Difference(round(100 * (gained - lost) / n, 2), low, high, round(test.pvalue, 4))


def _write(table: pd.DataFrame, path: Path) -> None:
    with whole_file(path) as part:
        table.to_csv(part, index=False)


if __name__ == "__main__":
    typer.run(main)
