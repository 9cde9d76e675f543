"""The command line with a fake search: options, outputs and exit codes.

The kinds of bad input are in `tests.bad_input`.
"""

import json
import math
import resource

import numpy as np
import pytest

import dcreg
from dcreg import Result, Stage, Status, SweepResult, Trace
from dcreg.cli import output
from dcreg.cli.options import with_options
from dcreg.io import READERS
from dcreg.names import DEFAULT_REL_GAP, DEFAULT_TIME_LIMIT_S, MODEL_DIM, START_BOXES
from tests.results import event, made_result, made_sweep, run

ISSUE_KEYS = {
    *("status", "T_target_source", "scale", "n_inliers", "bound", "mode", "lower_bound"),
    *("upper_bound", "gap", "gap_tol", "bound_ratio", "n_nodes", "n_assignments", "time_solve_s"),
    *("certificate_scope", "rmse_matched", "assignment"),
}


class Fake:
    """A function of the library that records its arguments and returns a given result at once."""

    def __init__(self, result):
        self.result, self.called = result, None

    def __call__(self, source, target, n_inliers, *, options, **keywords):
        clouds = {"source": source, "target": target}
        self.called = clouds | {"n_inliers": n_inliers, **keywords, **vars(options)}
        options.listener(event("end", upper=1.0, status=self.result.status.value))
        return self.result


@pytest.fixture
def fake(monkeypatch):
    """`dcreg.register` replaced by a fake."""
    trace = Trace([event(), event("end", status="optimal")])
    made = Fake(made_result(T_target_source=np.eye(3), assignment=np.array([[0, 0]]), trace=trace))
    monkeypatch.setattr(dcreg, "register", made)
    return made


@pytest.fixture
def fake_sweep(monkeypatch):
    """`dcreg.sweep` replaced by a fake."""
    made = Fake(made_sweep())
    monkeypatch.setattr(dcreg, "sweep", made)
    return made


def change(fake, **changes):
    fake.result = made_result(**{**vars(fake.result), **changes})


# --- options --------------------------------------------------------------------------------------

OPTIONS = {
    **{
        "--scale-range": (0.9, 1.1),
        "--mode": "paper",
        "--bound": "interval",
        "--abs-gap": 0.25,
        "--rel-gap": 0.1,
    },
    **{"--tol": 0.5, "--time-limit": 9.0, "--node-limit": 77, "--memory-limit-mb": 64.0},
    **{"--threads": 2, "--downsample": 50, "--start-box": "radius"},
}


@pytest.mark.parametrize("command", ["register", "sweep"])
def test_options_reach_the_library(call, sweep_call, fake, fake_sweep, command):
    arguments, used = (call, fake) if command == "register" else (sweep_call, fake_sweep)
    for option, value in OPTIONS.items():
        arguments += [option, *(value if isinstance(value, tuple) else [value])]
    assert run(*arguments, "--no-polish").exit_code == 0
    given = {f"--{name.replace('_', '-')}": value for name, value in used.called.items()}
    assert {name: given[name] for name in OPTIONS} == OPTIONS
    assert used.called["model"] == "similarity2d"
    assert used.called["polish"] is False


def test_defaults(call, fake):
    assert run(*call).exit_code == 0
    expected = vars(dcreg.SolveOptions()) | {"time_limit": DEFAULT_TIME_LIMIT_S}
    del expected["listener"]
    assert {name: fake.called[name] for name in expected} == expected
    assert fake.called["rel_gap"] == DEFAULT_REL_GAP
    unset = ("scale_range", "abs_gap", "tol", "node_limit", "memory_limit_mb", "candidates")
    assert [fake.called[name] for name in unset] == 6 * [None]


@pytest.mark.parametrize(("text", "pairs"), [("1", 1), ("1.0", 1.0), ("7", 7), ("0.5", 0.5)])
def test_count_or_fraction(call, fake, text, pairs):
    run(*call, "--n-inliers", text)
    assert fake.called["n_inliers"] == pairs
    assert type(fake.called["n_inliers"]) is type(pairs)


@pytest.mark.parametrize(
    ("text", "counts"),
    [
        ("6:12:3", [6, 9, 12]),
        ("6:8", [6, 7, 8]),
        ("6:11:3", [6, 9]),
        ("0.3:1.0:0.1", [0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]),
        ("0.5, 7 ,1.0", [0.5, 7, 1.0]),
        ("0.8:1.0:0.1,4", [0.8, 0.9, 1.0, 4]),
        ("7", [7]),
        (",", []),
    ],
)
def test_sweep_lists_and_ranges(sweep_call, fake_sweep, text, counts):
    run(*sweep_call, "--n-inliers", text)
    assert fake_sweep.called["n_inliers"] == counts
    assert list(map(type, fake_sweep.called["n_inliers"])) == list(map(type, counts))


def test_key_options(cloud_files, fake):
    source, target = cloud_files
    path = target.removesuffix(":a")
    arguments = ["register", source, path, "--model", "similarity2d", "--n-inliers", "3"]
    assert run(*arguments, "--target-key", "b").exit_code == 0
    assert len(fake.called["target"]) == 6
    assert "a, b; name one" in run(*arguments).stderr


@pytest.mark.parametrize("command", ["register", "sweep"])
def test_candidates_are_read_as_pairs(call, sweep_call, tmp_path, fake, fake_sweep, command):
    pairs = [[i, j] for i in range(12) for j in (i, (i + 1) % 12)]
    np.savetxt(tmp_path / "pairs.txt", pairs, fmt="%d")
    arguments, used = (call, fake) if command == "register" else (sweep_call, fake_sweep)
    assert run(*arguments, "--candidates", tmp_path / "pairs.txt").exit_code == 0
    lists = [sorted(columns) for columns in used.called["candidates"]]
    assert lists == [sorted([i, (i + 1) % 12]) for i in range(12)]


def test_help_and_version():
    outcome = run("--help")
    assert outcome.exit_code == 0
    for command in ("register", "register-matches", "sweep", "batch", "verify", "version"):
        assert command in outcome.stdout
    outcome = run("version")
    assert outcome.exit_code == 0
    assert outcome.stdout.startswith(f"dcreg {dcreg.__version__}\npython 3.")
    outcome = run("--version")
    assert outcome.exit_code == 0
    assert outcome.stdout == f"dcreg {dcreg.__version__}\n"


def test_help_lists_what_is_accepted():
    text = " ".join(run("register", "--help").stdout.replace("│", "").split())
    names = [*dcreg.bound_names(), *dcreg.mode_names("rigid3d"), *MODEL_DIM, *START_BOXES]
    for name in [*names, *READERS, "Equal numbers fix the scale"]:
        assert name in text
    assert "dcreg sweep a.txt b.txt" in run("sweep", "--help").stdout


# --- bad input ------------------------------------------------------------------------------------


def test_bad_file_exits_2_and_names_it(call, tmp_path, fake):
    bad = tmp_path / "bad.csv"
    bad.write_text("1,2\n3,nan\n")
    call[1] = bad
    outcome = run(*call)
    assert outcome.exit_code == 2
    assert outcome.stderr == (
        f"error: {bad}: NaN or infinity in 1 of 2 points, first in line 2; remove these points, or "
        "give --drop-invalid to leave them out\n"
    )
    assert fake.called is None


def test_an_output_that_is_an_input_stops_before_the_search(call, cloud_files, fake):
    source, _ = cloud_files
    before = source.read_bytes()
    outcome = run(*call, "--json", source)
    assert outcome.exit_code == 2
    assert f"--json {source}" in outcome.stderr
    assert "is also an input" in outcome.stderr
    assert fake.called is None
    assert source.read_bytes() == before


# --- results --------------------------------------------------------------------------------------


def test_outputs(call, tmp_path, fake):
    change(fake, lower_bound=-math.inf)
    paths = [tmp_path / name for name in ("o.json", "o.jsonl", "o.html")]
    before = set(tmp_path.iterdir())
    outcome = run(*call, "--json", paths[0], "--trace", paths[1], "--plot", paths[2])
    assert outcome.exit_code == 0
    assert set(tmp_path.iterdir()) - before == set(paths)  # no half-written neighbours stay
    content = json.loads(paths[0].read_text(), parse_constant=pytest.fail)
    assert set(content) >= ISSUE_KEYS
    assert content["lower_bound"] is None  # infinite
    assert content["n_nodes"] == 40
    assert content["T_target_source"] == np.eye(3).tolist()
    kinds = [json.loads(line)["kind"] for line in paths[1].read_text().splitlines()]
    assert kinds == ["bound", "end"]
    assert ".newPlot(" in paths[2].read_text()


def test_json_on_standard_output_is_its_only_content(call, fake):
    outcome = run(*call, "--json", "-")
    assert json.loads(outcome.stdout)["status"] == "optimal"
    assert "T_target_source" in outcome.stderr


@pytest.mark.parametrize(
    ("status", "code"),
    [
        *((Status.OPTIMAL, 0), (Status.CONVERGED, 0), (Status.TIME_LIMIT, 3)),
        *((Status.NODE_LIMIT, 3), (Status.MEMORY_LIMIT, 3), (Status.STOPPED, 3)),
    ],
)
def test_exit_code_by_status(call, tmp_path, fake, status, code):
    change(fake, status=status, lower_bound=0.0)
    outcome = run(*call, "--abs-gap", "0.1", "--json", tmp_path / "o.json")
    assert outcome.exit_code == code
    assert json.loads((tmp_path / "o.json").read_text())["status"] == status.value
    assert status.value in outcome.stdout
    assert ("not certified" in outcome.stdout) == (status is not Status.OPTIMAL)


def test_the_command_prints_what_the_result_prints(call, sweep_call, fake, fake_sweep):
    stages = [Stage("search", 1.25, 5, 9, Status.OPTIMAL, 0.5, 1.0)]
    change(fake, stages=[*stages, Stage("rotation", 1.25, 5, 9, Status.TIME_LIMIT, 2.0, 9.0)])
    assert run(*call).stdout == f"{fake.result}\n"
    assert run(*sweep_call).stdout == f"{fake_sweep.result}\n"


def test_full_disk_is_reported_after_the_pose(call, tmp_path, fake, monkeypatch):
    """A real write failure: files may not grow beyond 100 bytes after the search."""
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    path = tmp_path / "o.json"
    path.write_text("earlier result")
    summary = Result.summary

    def summary_then_limit(result):
        resource.setrlimit(resource.RLIMIT_FSIZE, (100, old[1]))
        return summary(result)

    monkeypatch.setattr(Result, "__str__", summary_then_limit)
    try:
        outcome = run(*call, "--json", path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
    assert outcome.exit_code == 4
    assert "T_target_source" in outcome.stdout
    assert f"error: cannot write {path}: File too large" in outcome.stderr
    assert path.read_text() == "earlier result"
    assert not list(tmp_path.glob(".*.part"))


def test_sweep_images_need_matplotlib_only(sweep_call, fake_sweep, tmp_path, monkeypatch):
    found = output.find_spec
    without = lambda name: None if name == "seaborn" else found(name)  # noqa: E731
    monkeypatch.setattr(output, "find_spec", without)
    outcome = run(*sweep_call, "--plot", tmp_path / "a.png")
    assert outcome.exit_code == 2
    assert ".png files need seaborn; install with: pip install seaborn" in outcome.stderr
    assert fake_sweep.called is None
    assert run(*sweep_call, "--plot", tmp_path / "a.html").exit_code == 0


def test_sweep_limit_exits_3_and_still_writes(sweep_call, fake_sweep, tmp_path):
    fake_sweep.result = made_sweep(Status.OPTIMAL, Status.TIME_LIMIT, Status.OPTIMAL)
    outcome = run(*sweep_call, "--out", tmp_path / "a.json")
    assert outcome.exit_code == 3
    assert "time_limit" in outcome.stdout
    content = json.loads((tmp_path / "a.json").read_text())
    assert content["status"] == "time_limit"
    assert [row["status"] for row in content["table"]] == ["optimal", "time_limit", "optimal"]


def test_sweep_unwritable_output_exits_4(sweep_call, fake_sweep, tmp_path, monkeypatch):
    def fail(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(SweepResult, "write_csv", fail)
    outcome = run(*sweep_call, "--out", tmp_path / "a.csv")
    assert outcome.exit_code == 4
    assert "No space left" in outcome.stderr
    assert "similarity pose" in outcome.stdout
    assert list(tmp_path.glob("*a.csv*")) == []


def test_a_tolerance_of_zero_gives_a_warning(call, fake):
    assert "--rel-gap 0: unless the fit is exact" in run(*call, "--rel-gap", "0").stderr
    assert "hardly ever" not in run(*call, "--rel-gap", "0", "--tol", "0.1").stderr
    assert "hardly ever" not in run(*call, "--abs-gap", "0").stderr


def test_messages_of_the_library_name_options():
    options = {
        "axis": "--axis",
        "n_inliers": "--n-inliers",
        "init": "--init",
        "max_rms": "--max-rms",
    }
    assert with_options("init: give n_inliers; omit init, or omit axis", options) == (
        "--init: give --n-inliers; omit --init, or omit --axis"
    )
    kept = "axis: the axis of max_rms_of, 'n_inliers' and initial poses; omit axis_of"
    assert with_options(kept, options) == kept.replace("axis:", "--axis:", 1)
