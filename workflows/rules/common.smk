# Shared by all stages. The experiment and the selection are checked here, before anything runs.

import functools
import logging
import os
import sys
import threading
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, workflow.basedir)

from snakemake.exceptions import WorkflowError
from snakemake.logging import logger
from snakemake_interface_executor_plugins.settings import ExecMode

from baselines import registry
from workflows.cluster import Measured
from workflows.config import ConfigError
from workflows.forking import run_stage
from workflows.hashing import digest, digest_files
from workflows.stages.commands import planned
from workflows.stages.plan import method_identity

CONFIG = str(config.get("experiment", "demo"))
SELECT = str(config.get("select") or "").split()  # as in "methods=icp,cpd tests=noise"
NEEDS = str(config.get("needs") or "")  # file with the needed blocks of every method

# Snakemake shows either all of its messages or none. `workflows run` shows none, and the errors on failure.
if "errors" in config and workflow.is_main_process:
    to_file = logging.FileHandler(config["errors"], encoding="utf-8")
    to_file.setLevel(logging.ERROR)
    logger.addHandler(to_file)

try:
    PLAN = planned(CONFIG, SELECT, Path(NEEDS) if NEEDS else None)
except ConfigError as error:
    raise WorkflowError(str(error))

EXPERIMENT = PLAN.experiment
OUT = f"results/{EXPERIMENT.name}"  # instances and runs
VIEW = str(Path(OUT) / PLAN.view)  # plan, metrics, tables and report: of the whole, or of a part
JOBS = [(method.name, chunk.name) for method, chunk in PLAN.jobs()]

# Every stage is `python -m workflows <name> *CHOICE ...` in a separate process, which receives the plan.
CHOICE = [CONFIG, *(word for part in SELECT for word in ("--select", part))]
CHOICE += ["--needs", NEEDS] if NEEDS else []
os.environ["PYTHONPATH"] = os.pathsep.join(
    [workflow.basedir, *filter(None, [os.environ.get("PYTHONPATH")])]
)
# Solve jobs that share a job of a cluster run one after the other.
is_remote = workflow.exec_mode == ExecMode.REMOTE
# Which other jobs share a node of a cluster is not known.
threads = min(EXPERIMENT.limits_of(method).threads for method in PLAN.methods)
jobs = 1 if "timing" in workflow.global_resources else max(1, (workflow.cores or 1) // threads)
os.environ["DCREG_PARALLEL_JOBS"] = "" if is_remote else str(jobs)


# `group-components` of a cluster's profile, once the rules are read, in the process that submits the jobs.
def group_sizes():
    return workflow.group_settings.group_components


@functools.cache
def measured():
    return Measured.of(EXPERIMENT, Path(OUT)) if group_sizes() else Measured()


@functools.cache
def solve_needs(method, chunk):
    limits = EXPERIMENT.limits_of(EXPERIMENT.method(method))
    return measured().job(method, limits, PLAN.chunk(chunk))


# A hash of the datasets of a chunk: there are thousands of chunks, and few sets of datasets.
@functools.cache
def of_datasets(hashed, datasets):
    return hashed(datasets)


# The part of the plan with these chunks: a job needs one at most, and a plan can have thousands.
def plan_of(*chunks):
    return replace(PLAN, chunks=tuple(map(PLAN.chunk, chunks)))


def cancel_timers():
    for thread in threading.enumerate():
        if isinstance(thread, threading.Timer):
            thread.cancel()


# These need no resources of a cluster; `fetch` needs a network.
localrules:
    all,
    tables,
    plan,
    fetch,
    record,


# Snakemake compares `params` with those of the last run. A hash of the sources that determine the output
# of a stage repeats exactly the stages that a change affects.
def sources(*entries):
    return digest_files(Path(workflow.basedir), entries)


def solve_identity(wildcards):
    return method_identity(EXPERIMENT, EXPERIMENT.method(wildcards.method))


# Looks at every file of the method, and there are thousands of jobs.
@functools.cache
def fingerprint(name):
    method = EXPERIMENT.method(name)
    return registry.fingerprint(method.baseline, options=method.options)


def solve_fingerprint(wildcards):
    return fingerprint(wildcards.method)


# An output as a result in Snakemake's own report: `make snakemake-report`.
def shown(path, caption, category, content):
    labels = {"experiment": EXPERIMENT.name, "part": Path(VIEW).name, "content": content}
    if VIEW == OUT:
        del labels["part"]
    caption = str(Path(workflow.basedir) / "workflows" / "captions" / f"{caption}.rst")
    return report(path, caption=caption, category=category, labels=labels)


wildcard_constraints:
    chunk=r"[23]d-\d+-[0-9a-f]{6}",
    method=r"[A-Za-z0-9._+-]+",
