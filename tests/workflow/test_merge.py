"""Joined results of several machines: what is kept, what is refused, and that nothing runs again."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from typer.testing import CliRunner

from workflows import archives, records
from workflows.__main__ import app
from workflows.blocks import Needs
from workflows.integrity import SUMS, DamagedError, digest, opened, sealed
from workflows.merge import JOURNAL, MergeError, merge

CHECKOUT = Path(__file__).parents[2]
CONFIG = """
name: joined
limits: {time_s: 20, memory_mb: 2048}
datasets:
  - {dataset: embedded, shapes: [fish], n_points: 10, tests: {noise: [0.0, 0.02]}}
methods:
  - {name: icp, baseline: icp}
  - {name: cpd, baseline: cpd}
"""
POSE = json.dumps([[1.0, 0.0, 0.5], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
EVENT = {
    "stage": "search", "kind": "end", "time_s": 0.1, "n_nodes": 4.0, "n_assignments": 16.0,
    "n_open": 0.0, "lower_bound": 0.99, "upper_bound": 1.0,
}  # fmt: skip


def run(number: int = 1, **changes: object) -> dict[str, object]:
    """A finished run of DC-Reg, as in a journal."""
    return {
        "run_id": f"run{number}", "instance_id": f"instance{number}", "instance_digest": "d1",
        "n_source": 10, "n_target": 10, "n_inliers": 10, "seed": 7, "fingerprint": "1",
        "machine_id": "m1", "status": "optimal", "message": "", "T_target_source": POSE,
        "lower_bound": 0.99, "upper_bound": 1.0, "n_nodes": 4, "n_assignments": 16,
        "time_solve_s": 0.1, "trace": [EVENT], **changes,
    }  # fmt: skip


def results(
    folder: Path, *rows: dict[str, object], method: str = "dcreg", options: str = "{}"
) -> Path:
    """Write results of experiment `joined` with these runs."""
    place = folder / "results" / "joined"
    journal = place / "runs" / method / "2d-00-abc.journal.jsonl"
    journal.parent.mkdir(parents=True, exist_ok=True)
    journal.write_text("".join(f"{sealed(row)}\n" for row in rows))
    line = {"method": method, "baseline": method, "options_effective": options}
    records.write(
        records.conform(
            pd.DataFrame([{**dict.fromkeys(records.PLAN, 0), **line}]), records.PLAN, ""
        ),
        place / "plan" / f"plan-{method}" / "plan" / "plan.parquet",
    )
    return place


def as_tables(*rows: dict[str, object]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The runs and their events."""
    events = [{"run_id": row["run_id"], **event} for row in rows for event in row["trace"]]
    return pd.DataFrame(rows).drop(columns="trace"), pd.DataFrame(events)


def archive(folder: Path, *rows: dict[str, object]) -> Path:
    """Write an archive of experiment `joined` with these runs of DC-Reg."""
    folder.mkdir()
    columns = ["experiment", "method", "baseline", "options_effective", *records.RAW]
    known = {
        "experiment": "joined",
        "method": "dcreg",
        "baseline": "dcreg",
        "options_effective": "{}",
    }
    table, events = as_tables(*({**known, **row} for row in rows))
    table.reindex(columns=columns).to_parquet(folder / archives.RUNS)
    events.assign(experiment="joined").to_parquet(folder / archives.TRACES)
    facts = {"created": "2026-01-01", "schema_version": records.SCHEMA_VERSION}
    (folder / "archive.json").write_text(json.dumps(facts))
    files = [path for path in folder.iterdir() if path.name != archives.CHECKSUMS]
    lines = [f"{digest(path)}  {path.name}\n" for path in files]
    (folder / archives.CHECKSUMS).write_text("".join(lines))
    return folder


def merged(out: Path, method: str = "dcreg") -> list[dict[str, object]]:
    text = (out / "joined" / "runs" / method / JOURNAL).read_text()
    return [opened(line) for line in text.splitlines()]


def test_runs_of_all_sources_are_kept_once(tmp_path):
    a = results(tmp_path / "a", run(1), run(2))
    b = results(tmp_path / "b", run(2, time_solve_s=9.0), run(3))
    results(tmp_path / "b", run(4), method="icp")
    (found,) = merge([a, b.parent], tmp_path / "out")
    assert (found.experiment, found.runs, found.duplicates) == ("joined", 4, 1)
    assert merged(tmp_path / "out") == [run(1), run(2), run(3)]
    assert merged(tmp_path / "out", "icp") == [run(4)]


def test_an_archive_is_a_source(tmp_path):
    stored = archive(tmp_path / "stored", run(1), run(2, status="unavailable"))
    a = results(tmp_path / "a", run(3))
    merge([a, stored], tmp_path / "out")
    rows = {row["run_id"]: row for row in merged(tmp_path / "out")}
    assert set(rows) == {"run1", "run3"}
    assert {name: rows["run1"][name] for name in run(1)} == run(1)


def test_a_damaged_archive_is_refused(tmp_path):
    stored = archive(tmp_path / "stored", run(1))
    (stored / archives.RUNS).write_bytes(b"damaged")
    with pytest.raises(archives.ArchiveError, match=r"runs\.parquet: damaged"):
        merge([stored], tmp_path / "out")


def test_another_instance_under_the_same_name_is_refused(tmp_path):
    a = results(tmp_path / "a", run(1))
    b = results(tmp_path / "b", run(1, run_id="other", instance_digest="d2"), method="icp")
    with pytest.raises(MergeError) as raised:
        merge([a, b], tmp_path / "out")
    for text in (a, b, "instance1", "instance_digest 'd1'", "'d2'", "leave one source out"):
        assert str(text) in str(raised.value)
    assert not list((tmp_path / "out").glob("*"))


def test_methods_that_receive_true_pairs_have_other_digests(tmp_path):
    a = results(tmp_path / "a", run(1))
    b = results(
        tmp_path / "b", run(1, run_id="other", instance_digest="d2"),
        method="teaser", options='{"front_end": "oracle", "oracle_outliers": 0.5}',
    )  # fmt: skip
    merge([a, b], tmp_path / "out")


def test_an_old_digest_next_to_the_new_one_is_no_contradiction(tmp_path):
    a = results(tmp_path / "a", run(1, instance_digest="old"), run(1))
    b = results(tmp_path / "b", run(1))
    merge([a, b], tmp_path / "out")
    assert [row["instance_digest"] for row in merged(tmp_path / "out")] == ["old", "d1"]


@pytest.mark.parametrize(
    ("change", "shown"),
    [
        ({"n_nodes": 5, "lower_bound": 1.1, "upper_bound": 1.2}, ("lower_bound against", "1.1")),
        ({"T_target_source": POSE.replace("0.5", "0.75")}, ("T_target_source", "0.75")),
        ({"status": "node_limit"}, ("status 'optimal'", "'node_limit'")),
    ],
)
def test_conflicting_results_are_refused(tmp_path, change, shown):
    a, b = results(tmp_path / "a", run(1)), results(tmp_path / "b", run(1, **change))
    with pytest.raises(MergeError) as raised:
        merge([a, b], tmp_path / "out")
    for text in (a, b, "run1", *shown, "leave the wrong source out"):
        assert str(text) in str(raised.value)


def test_other_work_with_consistent_bounds_is_counted(tmp_path):
    a, b = results(tmp_path / "a", run(1)), results(tmp_path / "b", run(1, n_nodes=5))
    (found,) = merge([a, b], tmp_path / "out")
    assert (found.duplicates, found.other_work, found.replaced) == (1, 1, 0)
    assert merged(tmp_path / "out") == [run(1)]


def test_a_better_run_of_another_machine_does_not_replace_one_whose_time_is_used(tmp_path):
    late = run(1, status="time_limit", time_solve_s=100.0)
    a = results(tmp_path / "a", late, run(2), run(3))
    b = results(tmp_path / "b", run(1, machine_id="m2"))
    for number, sources in enumerate([[a, b], [b, a]]):
        (found,) = merge(sources, tmp_path / f"out{number}", mixed_machines=True)
        assert next(r for r in merged(tmp_path / f"out{number}") if r["run_id"] == "run1") == late
        assert found.replaced == 0


def test_copies_of_a_run_make_no_machine_the_one_whose_times_are_used(tmp_path):
    late, other = run(1, status="time_limit"), {"machine_id": "m2"}
    unsupported = [run(number, status="unsupported") for number in (5, 6, 7)]
    copies = [results(tmp_path / name, late, run(2), *unsupported) for name in "ab"]
    more = results(tmp_path / "c", *(run(number, **other) for number in (1, 3, 4)))
    merge([*copies, more], tmp_path / "out", mixed_machines=True)
    assert next(r for r in merged(tmp_path / "out") if r["run_id"] == "run1") == run(1, **other)


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("status", ["time_limit", "failed"])
def test_the_run_that_the_clock_did_not_end_is_kept(tmp_path, status, reverse):
    a = results(tmp_path / "a", run(1))
    b = results(tmp_path / "b", run(1, status=status, n_nodes=2))
    (found,) = merge([b, a] if reverse else [a, b], tmp_path / "out")
    assert merged(tmp_path / "out") == [run(1)]
    assert found.replaced == 1


def test_versions_of_a_method_do_not_contradict_each_other(tmp_path):
    a = results(tmp_path / "a", run(1))
    b = results(tmp_path / "b", run(1, fingerprint="2", n_nodes=9))
    (found,) = merge([a, b], tmp_path / "out")
    assert found.runs == 2


def test_methods_that_are_not_deterministic_may_differ(tmp_path):
    a = results(tmp_path / "a", run(1), method="fpfh_fgr")
    b = results(tmp_path / "b", run(1, n_nodes=5), method="fpfh_fgr")
    merge([a, b], tmp_path / "out")
    assert merged(tmp_path / "out", "fpfh_fgr") == [run(1)]


def test_several_machines_are_refused_unless_asked(tmp_path):
    a, b = results(tmp_path / "a", run(1)), results(tmp_path / "b", run(2, machine_id="m2"))
    with pytest.raises(MergeError) as raised:
        merge([a, b], tmp_path / "out")
    for text in (a, b, "machine_id is 'm1' and 'm2'", "--mixed-machines"):
        assert str(text) in str(raised.value)
    (found,) = merge([a, b], tmp_path / "out", mixed_machines=True)
    assert found.machines == {"m1", "m2"}


def test_results_are_never_replaced(tmp_path):
    a = results(tmp_path / "a", run(1))
    with pytest.raises(MergeError, match="exists; give another folder"):
        merge([a], a.parent)
    done = CliRunner().invoke(app, ["merge", str(a), "--out", str(a.parent)])
    assert done.exit_code == 2


def test_a_folder_without_results_is_refused(tmp_path):
    with pytest.raises(MergeError, match="no such folder"):
        merge([tmp_path / "none"], tmp_path / "out")
    with pytest.raises(MergeError, match="no folder with runs"):
        merge([tmp_path], tmp_path / "out")


@pytest.mark.parametrize("name", ["a.parquet", "a.trace.parquet", "plan.parquet"])
@pytest.mark.parametrize("is_sealed", [True, False])
def test_a_damaged_table_of_a_source_is_refused(tmp_path, name, is_sealed):
    source = results(tmp_path / "a", run(1))
    runs, events = as_tables(run(2))
    records.write(runs, source / "runs" / "dcreg" / "a.parquet")
    records.write(events, source / "runs" / "dcreg" / "a.trace.parquet")
    (found,) = merge([source], tmp_path / "out")
    assert found.runs == 2
    (path,) = source.rglob(name)
    if not is_sealed:  # as of a copy without hidden files
        (path.parent / SUMS).unlink()
    content = path.read_bytes()
    for end in (0, 1, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:end])
        with pytest.raises(DamagedError) as raised:
            merge([source], tmp_path / "other")
        assert str(raised.value).startswith(f"{path}: {'damaged' if is_sealed else 'cannot be'}")
    done = CliRunner().invoke(app, ["merge", str(source), "--out", str(tmp_path / "other")])
    assert (done.exit_code, (tmp_path / "other").exists()) == (2, False)


def test_blocks_of_evidence_are_joined(tmp_path):
    a, b = results(tmp_path / "a", run(1)), results(tmp_path / "b", run(2))
    Needs({"noise": {"icp": 3}}).write(a / "evidence/needs.json")
    Needs({"noise": {"icp": 1, "cpd": 2}, "deformation": {"icp": 1}}).write(
        b / "evidence/needs.json"
    )
    merge([a, b], tmp_path / "out")
    needs = Needs.read(tmp_path / "out/joined/evidence/needs.json")
    assert needs.trials == {"noise": {"icp": 3, "cpd": 2}, "deformation": {"icp": 1}}


@pytest.mark.workflow
@pytest.mark.timeout(900)
def test_a_merged_folder_repeats_no_run(tmp_path):
    config = tmp_path / "joined.yaml"
    config.write_text(CONFIG)

    def sweep(folder: str, *part: str) -> Path:
        done = subprocess.run(
            [sys.executable, "-m", "workflows", "run", str(config), "--directory", tmp_path / folder,
             "--cores", "2", "--no-report", *part],
            cwd=CHECKOUT, capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        return tmp_path / folder / "results" / "joined"

    parts = [sweep("a", "--methods", "icp"), sweep("b", "--methods", "cpd")]
    merge(parts, tmp_path / "c" / "results")
    whole = sweep("c")
    table = pd.read_parquet(whole / "tables" / "runs.parquet")
    assert sorted(table["method"]) == ["cpd", "cpd", "icp", "icp"]
    made = [path for path in whole.glob("runs/*/*.journal.jsonl") if path.name != JOURNAL]
    assert made
    assert not any(path.read_text() for path in made)


def test_machines_that_round_differently_do_not_contradict(tmp_path):
    a = results(tmp_path / "a", run(1))
    b = results(tmp_path / "b", run(1, machine_id="m2", upper_bound=1.001))
    (found,) = merge([a, b], tmp_path / "out", mixed_machines=True)
    assert (found.runs, found.duplicates) == (1, 1)
    c = results(tmp_path / "c", run(1, machine_id="m2", upper_bound=0.9))  # below the lower bound
    with pytest.raises(MergeError, match="lower_bound against upper_bound"):
        merge([a, c], tmp_path / "out2", mixed_machines=True)
