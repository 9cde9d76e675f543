"""Tables keep their documented form, and files are whole or not there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from baselines.contract import Instance
from dcreg.status import Status
from workflows import UserError, outcomes, records
from workflows.config import Experiment
from workflows.hashing import digest_arrays
from workflows.instances import (
    Problem,
    Truth,
    content_digest,
    read_problems,
    read_truths,
    write_problems,
    write_truths,
)
from workflows.integrity import SUMS, sealed
from workflows.outcomes import OUTCOMES, stated
from workflows.stages.aggregate import accounting
from workflows.stages.solve import _plain, forget, solve


def test_a_table_survives_parquet_and_csv(tmp_path):
    rows = [{"run_id": "a", "time_solve_s": 0.1 + 0.2, "status": "optimal"}]
    rows += [{"run_id": "b", "n_source": 3}]
    columns = {name: records.RAW[name] for name in ("run_id", "status", "time_solve_s", "message")}
    table = records.frame(rows, columns)
    path = tmp_path / "t.parquet"
    records.write(table, path, csv=True)
    pd.testing.assert_frame_equal(records.read(path, columns), table)
    assert pd.read_csv(path.with_suffix(".csv"))["time_solve_s"][0] == 0.1 + 0.2
    assert sorted(p.name for p in tmp_path.iterdir()) == [SUMS, "t.csv", "t.parquet"]


def test_a_missing_or_wrong_column_is_named(tmp_path):
    path = tmp_path / "t.parquet"
    pd.DataFrame({"run_id": ["a"]}).to_parquet(path)
    with pytest.raises(records.SchemaError, match=r"t\.parquet: column 'chunk_id' is missing"):
        records.read(path, records.PLAN)
    table = pd.DataFrame({"level": ["much"]})
    with pytest.raises(records.SchemaError, match="column 'level'"):
        records.conform(table, {"level": records.PLAN["level"]}, "here")
    with pytest.raises(records.SchemaError, match="no such table"):
        records.read(tmp_path / "none.parquet", records.PLAN)


def test_tables_of_another_version_are_refused_with_the_command_that_makes_them(tmp_path):
    path = tmp_path / "runs.parquet"
    pd.DataFrame({"run_id": ["a"], "schema_version": 3}).to_parquet(path)
    with pytest.raises(records.SchemaError, match=r"version 3, .* `python -m workflows run EXP"):
        records.read(path, records.runs_columns())


def test_a_write_that_fails_leaves_the_old_file_and_no_part(tmp_path, monkeypatch):
    def full_disk(table, part, **options):
        part.write_text("half")
        raise OSError("no space left")

    path = tmp_path / "file"
    path.write_text("old")
    monkeypatch.setattr(pd.DataFrame, "to_parquet", full_disk)
    with pytest.raises(OSError, match="no space"):
        records.write(pd.DataFrame({"a": [1]}), path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_every_status_of_a_run_has_its_place_in_the_accounting():
    for status in Status:
        assert outcomes.outcome(status) in OUTCOMES
    with pytest.raises(UserError, match="unknown"):
        outcomes.outcome("unknown")


def test_accounting_adds_up_and_keeps_methods_that_never_ran():
    outcomes_of_runs = ["finished", "limited", "failed", "unavailable"]
    runs = pd.DataFrame({"method": ["a", "a", "a", "b"], "outcome": outcomes_of_runs})
    table = accounting(runs).set_index("method")
    assert table.loc["a"].to_dict() == {
        "planned": 3, "finished": 1, "limited": 1, "failed": 1, "unsupported": 0, "unavailable": 0,
        "not_needed": 0,
    }  # fmt: skip
    assert table.loc["b", "unavailable"] == 1


def test_accounting_refuses_an_outcome_it_does_not_know():
    with pytest.raises(AssertionError):
        accounting(pd.DataFrame({"method": ["a"], "outcome": ["lost"]}))


def test_all_columns_are_documented():
    assert all(column.meaning for column in records.runs_columns().values())
    assert all(column.meaning for column in records.TRACES.values())


@pytest.fixture
def problems(rng) -> list[Problem]:
    sizes = (4, 7)
    clouds = [(rng.random((n, 2)), rng.random((n + 1, 2))) for n in sizes]
    return [
        Problem(f"id{n}", "similarity2d", *pair, (0.5, 1.5), n, 0.1)
        for n, pair in zip(sizes, clouds, strict=True)
    ]


def test_packed_instances_come_back_bit_for_bit(problems, tmp_path):
    write_problems(tmp_path / "i.npz", problems)
    for old, new in zip(problems, read_problems(tmp_path / "i.npz"), strict=True):
        assert np.array_equal(old.source, new.source)
        assert np.array_equal(old.target, new.target)
        fields = ("instance_id", "model", "scale_range", "n_inliers_prior", "noise_bound")
        assert all(getattr(old, field) == getattr(new, field) for field in fields)


def test_truths_come_back_and_are_in_no_file_of_instances(problems, tmp_path, rng):
    truths = [
        Truth(p.instance_id, rng.random((3, 3)), np.array([[0, 1], [1, 0]])) for p in problems
    ]
    write_truths(tmp_path / "t.npz", truths)
    write_problems(tmp_path / "i.npz", problems)
    back = read_truths(tmp_path / "t.npz")
    assert np.array_equal(back["id7"].T_true, truths[1].T_true)
    assert np.array_equal(back["id7"].pairs, truths[1].pairs)
    with np.load(tmp_path / "i.npz") as file:
        assert not {"T_true", "pairs"} & set(file.files)
    assert not {"T_true", "pairs"} & set(Instance.__dataclass_fields__)


@pytest.mark.parametrize(("ratio", "expected"), [(1.0, 7), (0.5, 4), (0.01, 1), (2.0, 7)])
def test_the_prior_is_a_rounded_share_within_what_can_be_matched(problems, ratio, expected):
    assert problems[1].for_solver(ratio, 0).n_inliers == expected


def test_a_method_is_not_run_with_a_prior_of_more_pairs_than_points(problems, tmp_path):
    experiment = Experiment(
        name="more",
        datasets=[{"dataset": "embedded", "tests": {"noise": [0.01]}}],
        methods=[{"name": "icp", "baseline": "icp", "n_inliers_ratio": 1.5}],
    )
    write_problems(tmp_path / "i.npz", [problems[1]])
    said, out = [], tmp_path / "runs" / "chunk.parquet"
    solve(experiment, experiment.methods[0], tmp_path / "i.npz", out, said.append)
    (row,) = pd.read_parquet(out).to_dict("records")
    assert row["status"] == "unsupported"
    assert "n_inliers: 1.5 × 7 pairs exceed the 7 points of the smaller cloud" in row["message"]
    assert problems[1].lacks_points(1.5 / 1.4) == ""  # 7.5 pairs: rounding


def test_the_content_digest_sees_every_change(problems):
    given = problems[0].for_solver(1.0, 0)
    moved = replace(problems[0], source=problems[0].source + 1e-8).for_solver(1.0, 0)
    looser = replace(problems[0], noise_bound=problems[0].noise_bound * 1.0001).for_solver(1.0, 0)
    others = [problems[0].for_solver(0.5, 0), problems[0].for_solver(1.0, 1), moved, looser]
    assert content_digest(given) not in {content_digest(other) for other in others}
    assert content_digest(given) == content_digest(problems[0].for_solver(1.0, 0))


def test_the_content_digest_is_the_same_on_processors_that_round_differently(problems):
    given, other = problems[0].for_solver(1.0, 0), problems[0].for_solver(1.0, 0)
    for sign in (-1.0, 1.0):
        last = sign * np.spacing(np.abs(given.target).max())
        noise_bound = np.nextafter(other.noise_bound, sign * np.inf)
        near = replace(other, target=other.target + last, noise_bound=noise_bound)
        assert not np.array_equal(near.target, given.target)
        assert content_digest(near) == content_digest(given)


@pytest.mark.parametrize("largest", [0.25, 0.5, 1.0, 2.0, 1000.0])
def test_the_digest_of_normalised_points_does_not_depend_on_their_last_bit(largest):
    points = np.array([[-largest, 0.3 * largest], [0.1 * largest, largest]])
    near = [np.nextafter(points, way) for way in (-np.inf, np.inf)]
    assert len({digest_arrays(cloud) for cloud in (points, *near)}) == 1


def test_the_digest_of_whole_numbers_does_not_depend_on_their_size():
    pairs = np.array([[0, 3], [1, 2]])
    assert digest_arrays(pairs) == digest_arrays(pairs.astype(np.int32))
    assert digest_arrays(pairs) != digest_arrays(pairs + 1)


def test_forget_drops_only_runs_by_status_and_truncated_lines(tmp_path):
    folder = tmp_path / "icp"
    folder.mkdir()
    lines = [
        sealed({"run_id": "a", "status": "failed"}),
        sealed({"run_id": "b", "status": "optimal"}),
    ]
    (folder / "x.journal.jsonl").write_text("\n".join([*lines, '{"run_id"']))
    (folder / "y.journal.jsonl").write_text(lines[1] + "\n")
    for name in ("x.parquet", "y.parquet"):
        (folder / name).touch()
    assert forget(tmp_path, {"failed"}) == 2
    assert (folder / "x.journal.jsonl").read_text() == lines[1] + "\n"
    assert sorted(p.name for p in folder.glob("*.parquet")) == ["y.parquet"]


@pytest.mark.parametrize(
    ("status", "ratio", "expected"),
    [
        ("optimal", 0.0, "converged"),
        ("optimal", -3.0, "converged"),
        ("optimal", 1e-9, "optimal"),
        ("optimal", 1.0, "optimal"),
        ("optimal", None, "optimal"),
        ("optimal", float("nan"), "optimal"),
        ("time_limit", 0.0, "time_limit"),
    ],
)
def test_an_optimum_without_a_lower_bound_above_0_counts_as_converged(status, ratio, expected):
    assert stated(status, ratio) == expected
    if ratio is not None and ratio == ratio:  # the same rule for the answer of a worker
        answer = _plain({"status": status, "lower_bound": ratio, "upper_bound": 1.0}, 0.0)
        assert answer["status"] == (expected if answer["bound_ratio"] <= 0 else status)
