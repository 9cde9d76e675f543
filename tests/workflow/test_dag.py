"""The whole path on a tiny experiment: what runs, what does not run again, what faults become.

The stages run in a copy of the checkout, so that sources can be edited as a developer would.
"""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pandas as pd
import psutil
import pytest
from click.testing import Result
from rich.console import Console
from typer.testing import CliRunner

import workflows.metrics.errors
from reports.campaign import run as campaigning
from reports.campaign.campaign import Campaign
from reports.campaign.forecast import Forecast
from workflows.__main__ import app
from workflows.blocks import Needs
from workflows.integrity import DAMAGED, opened
from workflows.running import the_only_run

CHECKOUT = Path(__file__).parents[2]
FAULTY = CHECKOUT / "tests" / "workflow" / "baselines"
PARTS = (
    "CITATION.cff", "Snakefile", "workflows", "baselines", "data", "dcreg", "reports",
    "requirements.lock",
)  # fmt: skip

CONFIG = """
name: tiny
chunk_size: 4
limits: {time_s: 1, memory_mb: 600}
datasets:
  - {dataset: embedded, shapes: [fish], n_points: 12, tests: {noise: [0.0, 0.02]}}
  - {dataset: embedded, shapes: [fish], n_points: 13, tests: {deformation: [0.01]}}
methods:
  - {name: dcreg, baseline: dcreg}
  - {name: icp, baseline: icp}
"""
WAITING = """
name: waiting
limits: {time_s: 100, memory_mb: 600}
datasets:
  - {dataset: embedded, shapes: [fish], n_points: 12, tests: {noise: [0, 0.01, 0.02, 0.03, 0.04, 0.05]}}
methods:
  - {name: waits, baseline: fault, options: {fault: waits}}
"""
# Those that a limit of the config ends; memory runs out before the time does, also on a busy machine.
FAULTS = {"hangs": "", "grows": "time_s: 20"}

# Bounds that lose ten times the squared size of their box: valid, of the same order, and weaker. The
# adapter changes them: an edit of the library would compile all of its kernels again.
WEAKER = """

from dcreg.families.protocol import SpaceBound

_evaluate = SpaceBound.evaluate


def _weaker(self, boxes, cutoff):
    found = _evaluate(self, boxes, cutoff)
    found.lower_bounds -= 10 * ((boxes.upper - boxes.lower) ** 2).sum(axis=1)
    return found


SpaceBound.evaluate = _weaker
"""

pytestmark = [pytest.mark.workflow, pytest.mark.timeout(1800)]


class Checkout:
    """A copy of the sources with one experiment."""

    def __init__(self, root: Path) -> None:
        self.root = root
        for part in PARTS:
            if (CHECKOUT / part).is_dir():
                # With numba's caches, which hold as long as the sources' times are the same.
                shutil.copytree(CHECKOUT / part, root / part)
            else:
                shutil.copy(CHECKOUT / part, root / part)
        (root / "workflows" / "configs" / "tiny.yaml").write_text(CONFIG)

    @contextmanager
    def start(self, *arguments: str, module: str = "workflows") -> Iterator[subprocess.Popen[str]]:
        """Start a command in the checkout; it is killed where it has not ended by itself."""
        with subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            cwd=self.root,
            env={
                **os.environ,
                "PYTHONPATH": str(self.root),
                "DCREG_BASELINES_PATH": str(FAULTY),
                "DCREG_FAULT_TOKENS": str(self.root / "tokens"),
            },
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        ) as process:
            try:
                yield process
            finally:
                process.kill()

    def command(self, *arguments: str, ok: bool = True, module: str = "workflows") -> str:
        with self.start(*arguments, module=module) as process:
            output, _ = process.communicate(timeout=1200)
        assert (process.returncode == 0) == ok, output
        return output

    def recorded(self, *arguments: str) -> Result:
        """The outcome of a command on recorded versions."""
        return call(*arguments, "--history", str(self.root / "history"))

    def run(self, *arguments: str) -> list[str]:
        """Run the experiment; the stages that did something, in words of their own lines."""
        known = ("fetch", "generate", "solve", "evaluate", "aggregate", "report ")
        lines = self.command("run", "tiny", "--cores", "2", *arguments).splitlines()
        return sorted(
            " ".join(line.split()[:2] if line.startswith("solve") else line.split()[:1])
            for line in lines
            if line.startswith(known) and "…" not in line
        )

    def planned(self) -> list[str]:
        """The stages that the next run would repeat."""
        stages = []
        dry = ("--dry-run", "--nolock", "--config", "experiment=tiny")
        for line in self.command(*dry, module="snakemake").splitlines():
            if line.startswith("rule "):
                stages.append(line[5:].rstrip(":"))
            elif match := re.match(r" *wildcards: method=(\w+)", line):
                stages[-1] += f" {match[1]}"
        return sorted(set(stages) - {"all"})

    @contextmanager
    def edited(self, file: str, more: str = "\n# edited\n") -> Iterator[None]:
        """A context in which `more` stands at the end of a file."""
        path = self.root / file
        before = path.read_text()
        path.write_text(before + more)
        try:
            yield
        finally:
            path.write_text(before)

    def runs(self) -> pd.DataFrame:
        return pd.read_parquet(self.root / "results/tiny/tables/runs.parquet")


def call(*arguments: str) -> Result:
    """The outcome of a command that starts no process."""
    return CliRunner().invoke(app, arguments)


@pytest.fixture(scope="module")
def checkout(tmp_path_factory) -> Checkout:
    copy = Checkout(tmp_path_factory.mktemp("checkout"))
    copy.first = copy.run()
    return copy


TABLES = ["aggregate", "evaluate"]
AFTER_SOLVE = [*TABLES, "report"]
ALL = [*TABLES, "fetch", "generate", "report", "solve dcreg", "solve icp"]


def test_the_whole_path_leads_to_complete_tables(checkout):
    assert checkout.first == ALL
    runs = checkout.runs()
    assert len(runs) == 6
    assert set(runs["status"]) == {"optimal", "converged"}
    assert runs.loc[runs["method"] == "dcreg", "success"].all()
    assert (runs["objective_regret"] >= 0).all()
    assert (runs["bound_violation"].dropna() == 0).all()
    assert (runs["bound_violation"].notna() == (runs["method"] == "dcreg")).all()
    assert runs["time_overhead_s"].min() < 0.1 * runs["time_warmup_s"].max()
    tables = checkout.root / "results/tiny/tables"
    counts = pd.read_csv(tables / "accounting.csv")
    assert list(counts["planned"]) == [3, 3]
    known = json.loads((tables / "provenance.json").read_text())
    assert set(known["methods"]) == {"dcreg", "icp"}
    shown = [entry["run_id"] for entry in json.loads((tables / "overlays.json").read_text())]
    assert sorted(shown) == sorted(runs["run_id"])  # so few that each is shown, none twice
    traces = pd.read_parquet(tables / "traces.parquet")
    assert set(traces["run_id"]) == set(runs.loc[runs["method"] == "dcreg", "run_id"])
    report = (checkout.root / "results/tiny/report/index.html").read_text()
    assert "tiny" in report


def test_snakemakes_own_report_has_captions_and_needs_no_network(checkout):
    said = checkout.command("snakemake-report", "tiny")
    path = checkout.root / "results/tiny/snakemake-report.html"
    assert said.startswith("report ")
    text = path.read_text(encoding="utf-8")

    def shown(name: str) -> dict:
        script = rf'<script id="{name}">\s*var {name} = (.*);\s*</script>'
        return json.loads(re.search(script, text)[1])

    tables = {
        name.removeprefix("results/tiny/"): result for name, result in shown("results").items()
    }
    assert set(tables) == {
        "report/whole.html", "tables/runs.parquet", "tables/accounting.csv",
        "tables/provenance.json",
    }  # fmt: skip
    assert all(result["caption"] and result["labels"]["content"] for result in tables.values())
    assert tables["report/whole.html"]["labels"]["experiment"] == "tiny"
    assert set(shown("categories")) == {
        "Provenance", "Report", "Tables",
    }  # fmt: skip
    assert not re.search(r"<(script|link|img)[^>]*(src|href)=.?http", text)


def test_a_run_of_an_archive_is_not_repeated(checkout, tmp_path):
    checkout.command("archive", "--version", "1", module="reports")
    run = ("run", "tiny", "--cores", "2", "--no-report", "--directory", str(tmp_path))
    try:
        checkout.command(*run)
        results = tmp_path / "results/tiny"
        assert not [p for p in results.glob("runs/*/*.journal.jsonl") if _lines(p)]
        found = pd.read_parquet(results / "tables/runs.parquet")
        pd.testing.assert_frame_equal(found, checkout.runs())  # times as well
        fresh = tmp_path / "fresh"
        checkout.command(*run[:-1], str(fresh), "--fresh", "--methods", "icp")
        lines = [
            line for p in fresh.glob("results/tiny/runs/*/*.journal.jsonl") for line in _lines(p)
        ]
        assert len(lines) == 3
        own = tmp_path / "own"
        beside = ("--methods", "own", "--beside")
        added = "  - {name: own, baseline: icp, n_inliers_ratio: 0.5}\n"
        with checkout.edited("workflows/configs/tiny.yaml", added):
            checkout.command(*run[:-1], str(own), *beside)
        runs = pd.read_parquet(own / "results/tiny/evidence/tables/runs.parquet")
        assert set(runs["outcome"]) == {"finished"}
        assert list(runs.groupby("method").size()) == [3, 3, 3]
        made = {p.parent.name for p in own.glob("results/tiny/runs/*/*.journal.jsonl") if _lines(p)}
        assert made == {"own"}
    finally:
        shutil.rmtree(checkout.root / "reports/archive/1")


def test_a_run_that_is_not_needed_is_counted_and_not_made(checkout):
    """Only `dcreg` needs the block; its runs are those of the whole experiment, and none is repeated."""
    needs = checkout.root / "needs.json"
    Needs({"noise": {"dcreg": 1}}).write(needs)
    config = ("--config", "experiment=tiny", f"needs={needs}")
    options = ("--cores", "2", "--nolock", "--force-use-threads", "--quiet", "all")
    checkout.command("tables", *options, *config, module="snakemake")
    tables = checkout.root / "results/tiny/evidence/tables"
    runs = pd.read_parquet(tables / "runs.parquet").set_index("run_id")
    outcomes = runs.groupby("method")["outcome"].agg(list).to_dict()
    assert outcomes == {"dcreg": ["finished"] * 2, "icp": ["not_needed"] * 2}
    counts = pd.read_csv(tables / "accounting.csv").set_index("method")
    assert counts["planned"].to_dict() == {"dcreg": 2, "icp": 2}
    assert counts["not_needed"].to_dict() == {"dcreg": 0, "icp": 2}
    whole, made = checkout.runs().set_index("run_id"), runs[runs["method"] == "dcreg"]
    assert set(runs.index) < set(whole.index)
    times = whole.loc[made.index, "time_solve_s"]
    np.testing.assert_array_equal(made["time_solve_s"], times)
    assert not runs.loc[runs["method"] == "icp", "success"].any()
    checkout.command("experiment", str(tables), "page.html", module="reports")
    assert "not needed" in (checkout.root / "page.html").read_text()


def test_a_block_runs_although_tables_of_an_archive_lie_there(tmp_path, monkeypatch):
    monkeypatch.setenv("DCREG_ARCHIVES", "")
    config = tmp_path / "tiny.yaml"
    config.write_text(CONFIG)
    needs, console = Needs({"noise": {"icp": 1}}), Console(file=io.StringIO(), width=200)
    for place, added in (("made", {"icp": 2}), ("adopted", {"icp": 2, "dcreg": 2}), ("again", {})):
        campaign = Campaign(str(config), tmp_path / place)
        if place == "adopted":  # only tables, without the runs behind them
            made = tmp_path / "made/results/tiny/evidence/tables"
            shutil.copytree(made, campaign.folder / "tables")
            needs = needs.with_block("noise", ["dcreg"], [0.0, 0.02])
        if place == "again":  # Snakemake finds nothing to do
            campaign = Campaign(str(config), tmp_path / "adopted")
            needs = needs.with_block("deformation", ["icp"], [0.01])
            monkeypatch.setattr(campaigning, "run_snakemake", lambda *_, **__: 0)
        needs.write(campaign.needs_path)
        end, expected = time.monotonic() + 300.0, Forecast(2, 1.0, 0)
        ran = campaigning._run(
            campaign, "claim", expected, end=end, cores=2, out=tmp_path, console=console
        )
        assert ran == bool(added)
        runs = campaign.tables().runs
        counts = runs[runs["outcome"] != "not_needed"].groupby("method").size().to_dict()
        assert not added or counts == added
    assert "the tables lack runs of this step" in console.file.getvalue()


FIGURE = next((CHECKOUT / "reports" / "figures").glob("[a-z]*.py"))


@pytest.mark.parametrize(
    ("file", "repeated"),
    [
        (FIGURE, ["report"]),
        (Path(workflows.metrics.errors.__file__), AFTER_SOLVE),
    ],
    ids=["figure", "metric"],
)
def test_an_edit_repeats_only_what_depends_on_it(checkout, file, repeated):
    with checkout.edited(str(file.relative_to(CHECKOUT))):
        assert checkout.planned() == repeated


def test_an_added_method_solves_only_its_own_runs(checkout):
    added = "  - {name: half, baseline: icp, n_inliers_ratio: 0.5}\n"
    with checkout.edited("workflows/configs/tiny.yaml", added):
        assert checkout.planned() == sorted([*AFTER_SOLVE, "plan", "solve half"])


def test_a_part_has_tables_of_its_own_with_the_runs_of_the_whole(checkout):
    before = checkout.runs().set_index("run_id")
    assert "solve icp" not in checkout.run("--tests", "noise", "--methods", "dcreg", "--no-report")
    folder = checkout.root / "results/tiny/parts/methods-dcreg_tests-noise"
    part = pd.read_parquet(folder / "tables/runs.parquet").set_index("run_id")
    assert len(part) == 2
    # The very same runs, with their times, not new ones.
    assert part["time_solve_s"].equals(before.loc[part.index, "time_solve_s"])
    refused = checkout.recorded("record", str(folder), "--version", "x")
    assert "contains a part of the experiment" in refused.output
    # The whole is untouched, and a second run of it does nothing.
    assert checkout.runs().set_index("run_id").equals(before)
    assert checkout.planned() == []


def test_a_plan_is_printed_as_a_table_and_makes_nothing(checkout, tmp_path):
    files = sorted(checkout.root.glob("results/**/*"))
    config = tmp_path / "more.yaml"
    config.write_text(CONFIG + "  - {name: more, baseline: icp, n_inliers_ratio: 0.7}\n")
    part = ("--cores", "2", "--methods", "icp,more", "--directory", str(checkout.root))
    output = call("run", str(config), "--dry-run", *part).output
    assert "icp" in output
    assert "dcreg" not in output
    assert "6 runs, 3 of them finished; the rest takes" in output
    assert "at most 2 s on 2 cores" in " ".join(output.split())
    assert sorted(checkout.root.glob("results/**/*")) == files


def test_a_run_of_all_trials_is_announced_where_only_needed_ones_ran(tmp_path):
    config = tmp_path / "tiny.yaml"
    config.write_text(CONFIG)
    run = ("run", str(config), "--dry-run", "--directory", str(tmp_path))
    assert "only the trials" not in call(*run).output
    Needs({"noise": {"icp": 1}}).write(tmp_path / "results/tiny/evidence/needs.json")
    assert "reports evidence --experiments tiny" in call(*run).output
    assert "only the trials" not in call(*run, "--tests", "noise").output


def test_an_interrupted_job_keeps_what_it_had(checkout):
    """As after a kill: no final files, and a journal whose last line is cut off."""
    results = checkout.root / "results/tiny"
    before = checkout.runs().set_index("run_id")
    for made_from_runs in ("metrics", "tables", "report"):
        shutil.rmtree(results / made_from_runs, ignore_errors=True)
    journals = sorted((results / "runs/dcreg").glob("*.journal.jsonl"))
    (journal,) = [path for path in journals if len(_lines(path)) == 3]
    for path in (results / "runs/dcreg").iterdir():
        if path != journal:
            path.unlink()
    lines = _lines(journal)
    journal.write_text("\n".join([*lines[:2], lines[2][:40]]))
    assert checkout.run("--no-report") == [*TABLES, "solve dcreg"]
    after = checkout.runs().set_index("run_id")
    kept = [opened(line)["run_id"] for line in lines[:2]]
    again = opened(lines[2])["run_id"]
    assert after.loc[kept, "time_solve_s"].equals(before.loc[kept, "time_solve_s"])
    assert after.loc[again, "time_solve_s"] != before.loc[again, "time_solve_s"]
    assert len(_lines(journal)) == 4  # two old lines, the broken one, the new one


def test_damaged_files_are_set_aside_and_made_again(checkout):
    """As by a full disk or a bad sector: no damaged file is read, and no finished run is repeated."""
    before, results = checkout.runs(), checkout.root / "results/tiny"
    journals = sorted(results.glob("runs/*/*.journal.jsonl"))
    lines = list(map(_lines, journals))
    damaged = [
        *sorted(results.glob("runs/icp/*.parquet"))[:1], *sorted(results.glob("instances/*.npz"))[:1],
        *results.glob("metrics/metrics.parquet"),
    ]  # fmt: skip
    for path in damaged:
        content = bytearray(path.read_bytes())
        content[len(content) // 3] ^= 0xFF
        path.write_bytes(content)
    output = checkout.command("run", "tiny", "--cores", "2", "--no-report")
    for path in damaged:
        assert f"damaged   {path}: renamed" in output
        if path.parent.name != "metrics":  # which is made from runs, and removed
            assert path.with_name(path.name + DAMAGED).exists()
    pd.testing.assert_frame_equal(checkout.runs(), before)
    assert list(map(_lines, journals)) == lines


def _lines(path: Path) -> list[str]:
    return path.read_text().splitlines()


def test_a_weaker_bound_is_found_and_a_repetition_is_not(checkout):
    def record(version):
        folder = str(checkout.root / "results/tiny")
        assert checkout.recorded("record", folder, "--version", version).exit_code == 0

    record("v1")
    with checkout.edited("baselines/dcreg/adapter.py"):
        assert checkout.run("--no-report") == [*TABLES, "solve dcreg"]
        record("again")
    assert "no regression" in checkout.recorded("compare", "v1", "again").output
    with checkout.edited("baselines/dcreg/adapter.py", WEAKER):
        assert "solve dcreg" in checkout.run("--no-report")
        record("weaker")
    found = checkout.recorded("compare", "v1", "weaker")
    assert found.exit_code == 1
    assert "worse" in found.output
    assert "n_nodes" in found.output


def test_planted_faults_cost_their_runs_and_nothing_else(checkout):
    lines = [
        f"  - {{name: {fault}, baseline: fault, options: {{fault: {fault}}}, limits: {{{limit}}}}}\n"
        for fault, limit in FAULTS.items()
    ]
    with checkout.edited("workflows/configs/tiny.yaml", "".join(lines)):
        checkout.run("--no-report")
    runs = checkout.runs().set_index("method")
    for fault in FAULTS:
        ended = runs.loc[fault].groupby("test")["status"].agg(lambda s: "/".join(sorted(s)))
        assert dict(ended) == {"noise": "converged/converged", "deformation": "failed"}
    counts = pd.read_csv(checkout.root / "results/tiny/tables/accounting.csv", index_col="method")
    assert (counts["planned"] == 3).all()
    assert (counts.drop(columns="planned").sum(axis=1) == 3).all()
    assert list(runs.loc["dcreg", "status"]) == ["optimal"] * 3


class Waiting:
    """An experiment elsewhere of six runs, each of which waits until the test lets it go on."""

    def __init__(self, root: Path) -> None:
        self.root, self.allowed = root, 0
        self.config = root / "elsewhere" / "waiting.yaml"
        self.config.parent.mkdir()
        self.config.write_text(WAITING)
        (root / "tokens").mkdir()

    def allow(self, count: int) -> list[str]:
        """Let `count` more runs go on; lines of the journal once they are finished."""
        for number in range(self.allowed, self.allowed + count):
            (self.root / "tokens" / str(number)).touch()
        self.allowed += count
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline:
            journals = self.root.glob("results/waiting/runs/waits/*.journal.jsonl")
            lines = [line for path in journals for line in _lines(path)]
            if len(lines) >= self.allowed:
                return lines
            time.sleep(0.05)
        raise AssertionError(f"no {self.allowed} runs within two minutes")


def test_a_run_that_is_stopped_or_killed_goes_on_from_there(checkout, monkeypatch):
    monkeypatch.setenv("DCREG_BASELINES_PATH", str(FAULTY))
    waiting = Waiting(checkout.root)
    run = ["run", str(waiting.config), "--cores", "1", "--no-report"]
    other = [*run, "--directory", str(checkout.root)]
    with checkout.start(*run) as first:
        kept = waiting.allow(2)
        assert f"another run uses these results: process {first.pid} " in call(*other).output
        family = psutil.Process(first.pid).children(recursive=True)
        assert len(family) >= 3  # Snakemake, the job, its worker
        first.send_signal(signal.SIGINT)
        output, _ = first.communicate(timeout=60)
    assert first.returncode == 130
    assert "Finished runs are kept" in output
    assert "Traceback" not in output
    _, alive = psutil.wait_procs(family, timeout=30)
    assert not alive

    with checkout.start(*run) as second:
        assert waiting.allow(1)[:2] == kept
        (snakemake, *_) = psutil.Process(second.pid).children()
        second.kill()
        assert f"its Snakemake is process {snakemake.pid}" in call(*other).output
        assert waiting.allow(3)[:2] == kept
        snakemake.wait(timeout=60)
    with the_only_run(checkout.root, "waiting"):
        pass
    runs = pd.read_parquet(checkout.root / "results/waiting/tables/runs.parquet")
    assert list(runs["status"]) == ["converged"] * 6


def test_an_error_of_snakemake_itself_is_shown(checkout):
    (checkout.root / "results/other").mkdir()
    (checkout.root / "results/other/plan").write_text("a file where a folder should be")
    config = checkout.root / "other.yaml"
    config.write_text(CONFIG.replace("name: tiny", "name: other"))
    output = checkout.command("run", str(config), "--cores", "1", ok=False)
    assert "results/other/plan" in output.partition("error:")[0]


def test_own_cloud_pairs_need_a_card_and_a_config_of_a_few_lines(checkout):
    """As in the manual: seven lines, and no other file is edited."""
    rng = np.random.default_rng(1)
    T = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])

    def write_pair(name, n_points):
        place = checkout.root / "my clouds" / name
        place.mkdir(parents=True, exist_ok=True)
        source = rng.random((n_points, 2))
        np.savetxt(place / "source.txt", source)
        np.savetxt(place / "target.csv", source @ T[:2, :2].T, delimiter=",")
        np.savetxt(place / "pose.txt", T)

    write_pair("one", 15)
    write_pair("two", 15)
    card = checkout.root / "data" / "my_clouds" / "card.yaml"
    card.parent.mkdir()
    card.write_text(
        "name: my_clouds\ndim: 2\nloader: pairs\n"
        f"parameters: {{folder: {checkout.root / 'my clouds'}, tolerance: 0.001}}\n"
    )
    config = checkout.root / "mine.yaml"
    config.write_text(
        "name: mine\n"
        "datasets: [{dataset: my_clouds, tests: {pair: [0]}}]\n"
        "methods: [{name: dcreg, baseline: dcreg}]\n"
    )
    checkout.command("run", str(config), "--no-report", "--cores", "2")
    runs = pd.read_parquet(checkout.root / "results/mine/tables/runs.parquet")
    assert sorted(runs["shape"]) == ["one", "two"]
    assert runs["success"].all()
    write_pair("one", 16)  # it alone is solved anew
    checkout.command("run", str(config), "--no-report", "--cores", "2")
    solved = [
        opened(line)["n_source"]
        for path in sorted(checkout.root.glob("results/mine/runs/*/*.journal.jsonl"))
        for line in _lines(path)
    ]
    assert sorted(solved) == [15, 15, 16]


def planned_by_snakemake(directory: Path, experiment: str) -> tuple[int, str]:
    """Exit code and messages of Snakemake, called without `workflows run`."""
    done = subprocess.run(
        [sys.executable, "-m", "snakemake", "--snakefile", str(CHECKOUT / "Snakefile"), "--dry-run",
         "--directory", str(directory), "--config", f"experiment={experiment}"],
        cwd=CHECKOUT, capture_output=True, text=True,
    )  # fmt: skip
    assert not (directory / "results").exists()
    return done.returncode, done.stdout + done.stderr


def test_a_wrong_config_stops_before_anything_runs(tmp_path):
    config = tmp_path / "bad.yaml"
    config.write_text(CONFIG.replace("time_s", "time"))
    done = call("run", str(config), "--directory", str(tmp_path))
    for code, output in (
        (done.exit_code, done.output),
        planned_by_snakemake(tmp_path, str(config)),
    ):
        assert code != 0
        assert "limits.time: unknown key; did you mean 'time_s'?" in output


def test_the_dag_of_an_experiment_in_2d_and_3d_can_be_planned(tmp_path):
    code, output = planned_by_snakemake(tmp_path, "demo")
    assert code == 0, output
    assert "results/demo/report/index.html" in output
