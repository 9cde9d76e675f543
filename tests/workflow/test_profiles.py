"""Profiles for clusters: what their jobs request, which jobs share one, and how they are submitted.

`make test-slurm` runs a real Slurm. A stand-in for `kubectl` runs the manifests here.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
import yaml
from click.testing import Result
from typer.testing import CliRunner

from tests.slurm import __main__ as slurm_test
from tests.slurm import cluster as slurm_cluster
from workflows.__main__ import app
from workflows.cluster import JOB_MB, JOB_S, JobNeeds, Measured
from workflows.config import load
from workflows.records import SCHEMA_VERSION
from workflows.running import PROFILES, cores_of_job, find_profile
from workflows.stages.plan import expand

CHECKOUT = Path(__file__).parents[2]
NAMES = ("slurm", "kubernetes")
KUBERNETES = PROFILES / "kubernetes"
CONFIG = """
name: few
chunk_size: 2
limits: {time_s: 100, memory_mb: 600, assignments: 50, safety_s: 200, threads: 2}
datasets:
  - {dataset: embedded, shapes: [fish], n_points: 9, tests: {noise: [0, 0.02], deformation: [0, 0.02]}}
methods:
  - {name: dcreg, baseline: dcreg}
  - {name: icp, baseline: icp, limits: {threads: 1}}
"""

pytestmark = [pytest.mark.workflow, pytest.mark.timeout(600)]


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "few.yaml"
    path.write_text(CONFIG)
    return path


def settings(name: str) -> dict:
    return yaml.safe_load((PROFILES / name / "profile.yaml").read_text())


def needs_plugin(name: str) -> None:
    executor = settings(name)["executor"]
    module = f"snakemake_executor_plugin_{executor.replace('-', '_')}"
    if not importlib.util.find_spec(module):
        pytest.skip(f"the executor plug-in {executor} is not installed: requirements-cluster.lock")


def call(*arguments: str) -> Result:
    return CliRunner().invoke(app, arguments)


def write_runs(folder: Path, rows: list[dict]) -> None:
    (folder / "tables").mkdir(parents=True)
    table = pd.DataFrame(rows).assign(schema_version=SCHEMA_VERSION)
    table.to_parquet(folder / "tables" / "runs.parquet")


def row(method: str, seconds: float | None, memory: float, outcome: str = "finished") -> dict:
    return {
        "method": method, "test": "noise", "outcome": outcome, "time_solve_s": seconds,
        "time_overhead_s": 0.5, "time_warmup_s": 2.0, "peak_memory_mb": memory,
    }  # fmt: skip


# --- what a job needs ---------------------------------------------------------------------------


def test_needs_are_measured_where_runs_exist_and_limits_otherwise(config, tmp_path):
    few = load(str(config))
    dcreg, icp = few.methods
    (chunk, *_) = expand(few).chunks
    folder = tmp_path / "results" / "few"
    limits = few.limits_of(icp)
    unknown = Measured.of(few, folder).job("icp", limits, chunk)
    assert unknown.expected_s >= 2 * limits.time_s
    assert unknown.memory_mb(1) == unknown.memory_mb(2) == JOB_MB + 600

    write_runs(folder, [row("icp", 1.5, 80), row("icp", 2.5, 160), row("icp", None, 10)])
    known = Measured.of(few, folder)
    assert known.seconds == {("icp", "noise"): 2.5}  # with 0.5 s of the harness
    needs = known.job("icp", limits, chunk)
    seen = sum(instance.test == "noise" for instance in chunk.instances)
    assert 0 < seen < len(chunk.instances)
    fixed = needs.expected_s - seen * 2.5 - (len(chunk.instances) - seen) * limits.time_s
    assert 2.0 < fixed < 30.0  # the start, and the warm-up of 2 s
    assert needs.memory_mb(1) == JOB_MB + 200
    assert needs.memory_mb(2) == JOB_MB + 600
    assert known.job("dcreg", few.limits_of(dcreg), chunk).expected_s >= 400


def test_runs_of_the_quick_part_that_hit_a_limit_take_the_limit_of_the_experiment(config, tmp_path):
    few = load(str(config))
    quick = [row("icp", 1.0, 80), row("icp", 1.0, 80, "limited")]
    write_runs(tmp_path / "results" / "few-quick", quick)
    known = Measured.of(few, tmp_path / "results" / "few")
    assert known.seconds["icp", "noise"] == pytest.approx((1.5 + 100.5) / 2)
    write_runs(tmp_path / "results" / "few", [row("icp", 3.0, 20)])  # its own runs count first
    known = Measured.of(few, tmp_path / "results" / "few")
    assert known.seconds["icp", "noise"] == 3.5
    assert known.memory_mb["icp"] == 80


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seconds", [JOB_S, 40.0, 200.0, 599.0, 601.0, 1e4])
def test_solve_jobs_share_a_job_that_lasts_five_to_thirty_minutes(name, seconds):
    sizes = settings(name)["group-components"]
    needs = JobNeeds(seconds, 1e6, 100, 200)
    group = needs.group(sizes)
    lasts = seconds * sizes[group] if group else min(seconds, 60 * needs.minutes(1))
    assert 5 * 60 <= lasts <= 30 * 60
    assert needs.group({}) is None
    assert needs.minutes(1) * 60 >= min(2 * seconds, 1800)
    assert needs.minutes(2) * 60 >= min(4 * seconds, 1800)
    assert needs.minutes(5) <= 30
    limited = JobNeeds(seconds, seconds, 1, 1)  # the experiment's limits allow no more
    assert limited.minutes(1) * 60 < seconds + 60


# --- the profiles -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_dry_run_with_a_profile(name, config, tmp_path):
    needs_plugin(name)
    measured = [
        {**row(method, seconds, 80.0), "test": test}
        for method, seconds in (("icp", 0.5), ("dcreg", 100.0))
        for test in ("noise", "deformation")
    ]
    write_runs(tmp_path / "results" / "few", measured)
    done = subprocess.run(
        [sys.executable, "-m", "snakemake", "--snakefile", str(CHECKOUT / "Snakefile"), "--dry-run",
         "--directory", str(tmp_path), "--profile", str(PROFILES / name), "--cores", "2",
         "--config", f"experiment={config}"],
        cwd=tmp_path, capture_output=True, text=True,
    )  # fmt: skip
    output = done.stdout + done.stderr
    assert done.returncode == 0, output
    first, *parts = re.split(r"\bGroup job ", output)
    groups = {part.split()[0]: part.partition("\n[")[0] for part in parts}
    assert set(groups) == {"generate", "solve-x64", "solve-x4", "tables"}
    assert [groups["solve-x64"].count(f"method={each}") for each in ("icp", "dcreg")] == [2, 0]
    assert [groups["solve-x4"].count(f"method={each}") for each in ("icp", "dcreg")] == [0, 2]
    assert groups["solve-x64"].count("runtime=1,") == groups["solve-x4"].count("runtime=8,") == 2
    assert groups["solve-x4"].count(f"mem_mb={JOB_MB + 100},") == 2
    assert groups["solve-x4"].count("threads: 2") == 2
    for rule in ("evaluate", "aggregate", "report"):
        assert f"rule {rule}:" in groups["tables"]
    for rule in ("plan", "fetch"):
        assert f"rule {rule}:" in first


def test_an_unknown_profile_is_named_with_the_known_ones(config, tmp_path):
    done = call("run", str(config), "--directory", str(tmp_path), "--profile", "slrm")
    assert done.exit_code == 2
    assert "--profile slrm: no such profile; did you mean 'slurm'?" in done.output
    assert not (tmp_path / "results").exists()


def test_a_profile_whose_executor_is_missing_names_the_package(tmp_path):
    (tmp_path / "profile.yaml").write_text("executor: no-such\n")
    with pytest.raises(ValueError, match="needs the package snakemake-executor-plugin-no-such"):
        find_profile(str(tmp_path))
    (tmp_path / "profile.yaml").write_text("- executor\n")
    with pytest.raises(ValueError, match="must map the names of Snakemake's options"):
        find_profile(str(tmp_path))
    (tmp_path / "profile.yaml").write_text("jobs: 5\n")  # on top of another profile
    assert not find_profile(str(tmp_path)).is_remote


def test_a_job_has_the_threads_of_the_method_with_the_most(config):
    assert cores_of_job(load(str(config))) == "2"
    assert cores_of_job(load("paper3d")) == "1"


def test_both_profiles_group_alike():
    one, other = map(settings, NAMES)
    for key in ("groups", "group-components", "set-resources", "default-resources", "cores"):
        assert one[key] == other[key]


# --- Kubernetes ---------------------------------------------------------------------------------

# Runs the container's command of a job at once, and remembers how it ended.
KUBECTL = """#!/usr/bin/env python3
import json, os, subprocess, sys
from pathlib import Path
folder = Path(__file__).parent / "jobs"
folder.mkdir(exist_ok=True)
verb, *rest = sys.argv[1:]
if verb == "create":
    job = json.load(sys.stdin)
    name = f"job.batch/{job['metadata']['generateName']}{len(list(folder.iterdir()))}"
    place = folder / name.replace("/", "-")
    (container,) = job["spec"]["template"]["spec"]["containers"]
    env = {**os.environ, **{each["name"]: each["value"] for each in container["env"]}}
    place.write_text(json.dumps(job))
    done = subprocess.run(container["command"], env=env, capture_output=True, text=True)
    place.with_suffix(".log").write_text(done.stdout + done.stderr)
    job["ended"] = done.returncode
    place.write_text(json.dumps(job))
    print(name)
elif verb == "get":
    place = folder / rest[0].replace("/", "-")
    if place.exists():
        print("name", "Failed" if json.loads(place.read_text())["ended"] else "Complete")
"""


@pytest.fixture
def kubectl(tmp_path, monkeypatch) -> Path:
    """The folder of the jobs that were created."""
    place = tmp_path / "bin"
    place.mkdir()
    (place / "kubectl").write_text(KUBECTL)
    (place / "kubectl").chmod(0o755)
    monkeypatch.setenv("PATH", f"{place}{os.pathsep}{os.environ['PATH']}")
    values = {"IMAGE": "example.org/dcreg:1", "CLAIM": "results", "VOLUME": str(tmp_path)}
    for name, value in values.items():
        monkeypatch.setenv(f"DCREG_{name}", value)
    return place / "jobs"


def test_an_experiment_runs_by_jobs_of_kubernetes(tmp_path, kubectl):
    needs_plugin("kubernetes")
    config = tmp_path / "small.yaml"
    config.write_text(
        "{name: small, datasets: [{dataset: embedded, shapes: [fish], n_points: 12, "
        "tests: {noise: [0.0, 0.02]}}], methods: [{name: icp, baseline: icp}, "
        "{name: half, baseline: icp, n_inliers_ratio: 0.5}]}"
    )
    (tmp_path / "profile.yaml").write_text("seconds-between-status-checks: 1\n")
    done = subprocess.run(
        [sys.executable, "-m", "workflows", "run", str(config), "--directory", str(tmp_path),
         "--no-report", "--fresh", "--profile", "kubernetes", "--profile", str(tmp_path)],
        cwd=CHECKOUT, capture_output=True, text=True,
    )  # fmt: skip
    logs = "\n".join(path.read_text() for path in kubectl.glob("*.log"))
    assert done.returncode == 0, done.stdout + done.stderr + logs
    runs = pd.read_parquet(tmp_path / "results" / "small" / "tables" / "runs.parquet")
    assert list(runs["outcome"]) == ["finished"] * 4
    jobs = [json.loads(path.read_text()) for path in kubectl.iterdir() if path.suffix != ".log"]
    assert len(jobs) == 3  # generate, two of solve, and evaluate with aggregate
    assert all(job["ended"] == 0 for job in jobs)


def test_a_manifest_has_what_the_job_script_states(tmp_path):
    manifest = runpy.run_path(str(KUBERNETES / "submit.py"))["manifest"]
    script = tmp_path / "job.sh"
    stated = {"threads": 3, "resources": {"mem_mb": 2500, "runtime": 20, "tmpdir": "/tmp"}}
    script.write_text(f"#!/bin/sh\n# properties = {json.dumps(stated)}\ntrue\n")
    environment = {"DCREG_IMAGE": "i", "DCREG_CLAIM": "c", "DCREG_VOLUME": "/v", "HOME": "/root"}
    job = manifest(str(script), environment)
    spec = job["spec"]["template"]["spec"]
    (container,), (volume,) = spec["containers"], spec["volumes"]
    share = {"cpu": "3", "memory": "2500Mi"}
    assert container["resources"] == {"requests": share, "limits": share}
    assert container["command"] == ["/bin/sh", str(script)]
    assert {each["name"] for each in container["env"]} == set(environment) - {"HOME"}
    assert container["volumeMounts"] == [{"name": volume["name"], "mountPath": "/v"}]
    assert volume["persistentVolumeClaim"] == {"claimName": "c"}
    assert job["spec"]["activeDeadlineSeconds"] == 1200


@pytest.mark.parametrize(
    ("shown", "state"),
    [
        ("name", "running"),
        ("name SuccessCriteriaMet Complete", "success"),
        ("name FailureTarget Failed", "failed"),
        ("", "failed"),  # deleted
        (None, "running"),  # the cluster does not answer
    ],
)
def test_status_of_a_job_of_kubernetes(shown, state, tmp_path):
    kubectl = tmp_path / "kubectl"
    kubectl.write_text("#!/bin/sh\n" + ("exit 1" if shown is None else f"echo '{shown}'"))
    kubectl.chmod(0o755)
    env = {**os.environ, "PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run([KUBERNETES / "status.sh", "job.batch/a"], env=env, capture_output=True)
    assert done.stdout.decode().strip() == state


def test_a_submission_without_an_image_says_what_is_missing(tmp_path, monkeypatch):
    monkeypatch.delenv("DCREG_IMAGE", raising=False)
    done = subprocess.run([KUBERNETES / "submit.py", "job.sh"], capture_output=True, text=True)
    assert done.returncode == 1
    assert "DCREG_IMAGE is not set" in done.stderr


def test_the_manifest_of_the_driver_fits_the_profile():
    documents = list(yaml.safe_load_all((KUBERNETES / "driver.yaml").read_text()))
    job = documents[-1]["spec"]["template"]["spec"]
    (container,), (volume,) = job["containers"], job["volumes"]
    given = {each["name"]: each["value"] for each in container["env"]}
    assert given["DCREG_IMAGE"] == container["image"]
    assert given["DCREG_CLAIM"] == volume["persistentVolumeClaim"]["claimName"]
    assert given["DCREG_VOLUME"] == container["volumeMounts"][0]["mountPath"]
    assert container["args"][container["args"].index("--directory") + 1] == given["DCREG_VOLUME"]
    assert job["serviceAccountName"] == documents[0]["metadata"]["name"]


# --- the container ------------------------------------------------------------------------------


def test_container_recipe_has_no_lint():
    if not (hadolint := shutil.which("hadolint", path=str(Path(sys.executable).parent))):
        pytest.skip("hadolint is not installed: requirements-dev.lock")
    recipe = KUBERNETES / "Containerfile"
    done = subprocess.run([hadolint, "--no-color", recipe], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


@pytest.fixture(scope="module")
def recipe() -> str:
    return (KUBERNETES / "Containerfile").read_text().replace("\\\n", " ")


def test_container_is_made_from_the_lock_files(recipe):
    assert "workflows/setup.sh .venv" in recipe  # which installs requirements.lock
    assert "--require-hashes --requirement requirements-cluster.lock" in recipe
    makefile = (CHECKOUT / "Makefile").read_text()
    system = re.search(r"^SYSTEM_PACKAGES := (.*)$", makefile, re.M)[1].split()
    assert set(system) <= set(recipe.split())
    assert re.search(r"^FROM \S+:\d+\.\d+\.\d+\S*$", recipe, re.M)  # a fixed version
    assert re.findall(r"^USER (\S+)$", recipe, re.M)[-1].isdecimal()  # not root


def test_container_has_all_sources_of_an_experiment(recipe, tmp_path):
    for line in re.findall(r"^COPY (.*)$", recipe, re.M):
        *sources, target = line.split()[1:]
        for source in map(CHECKOUT.joinpath, sources):
            if source.is_dir():
                shutil.copytree(source, tmp_path / target)
            else:
                shutil.copy(source, tmp_path / target)
    done = subprocess.run(
        [sys.executable, "-m", "snakemake", "--dry-run", "--config", "experiment=demo"],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(tmp_path)}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "results/demo/report/index.html" in done.stdout + done.stderr


# --- make test-slurm ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("prepare", "reason"),
    [
        (lambda patch: patch.setattr(os, "geteuid", lambda: 1000), "it needs root"),
        (lambda patch: patch.setattr(slurm_cluster, "CONF", Path(__file__)), "exists"),
        (lambda patch: patch.setattr(slurm_cluster, "DAEMONS", ("python",)), "is running"),
    ],
    ids=["root", "configured", "running"],
)
def test_slurm_is_skipped_with_a_reason(prepare, reason, monkeypatch, capsys):
    needs_plugin("slurm")
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(slurm_cluster, "CONF", Path("/nowhere/slurm.conf"))
    monkeypatch.setattr(slurm_cluster, "DAEMONS", ())
    monkeypatch.setattr(slurm_test, "install", lambda: pytest.fail("nothing may be installed"))
    prepare(monkeypatch)
    slurm_test.main()
    output = capsys.readouterr().out
    assert output.startswith("skipped   make test-slurm: ")
    assert reason in output
