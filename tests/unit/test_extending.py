"""The files of `docs/extending.md` are written into a copy of the project and found by discovery."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
FILES = dict(re.findall(r"^```(?:python|yaml)\n# (\S+)\n(.*?)^```", PAGE, re.M | re.S))
PACKAGES = ("dcreg", "baselines", "data", "workflows", "reports")
MOST_LINES = 20

CHECKS = """
import numpy as np

import dcreg
from baselines import registry
from baselines.contract import Instance, Limits
from data.registry import dataset
from dcreg.families.protocol import Space
from dcreg.families.registry import make_bound
from dcreg.families.rigid2d.space import Rigid2D
from dcreg.search import Budget, Tolerance, minimise
from reports.figures import standalone
from workflows.discovery import modules
from workflows.disturb import make_instance
from workflows.metrics import METRICS

shape = dataset("circle")
made = make_instance(shape, "circle", "noise", 0.01, trial=0, n_points=12)
assert made.source.shape == (12, 2)

method = registry.load("my_method")
assert "my_method" in registry.names()
assert method.options["gain"] == 1.0

rng = np.random.default_rng(0)
source = rng.standard_normal((8, 2))
target = source @ [[0.0, 1.0], [-1.0, 0.0]] + 0.1 * rng.standard_normal((8, 2))
space = Rigid2D(source - source.mean(axis=0), target - target.mean(axis=0), 8)
for name in ("ball", "tight"):
    found = minimise(space, make_bound(name, space), Budget(nodes=5000), tolerance=Tolerance(abs=0.05))
    assert found.status == "optimal", (name, found.status)
    assert found.lower_bound <= found.upper_bound
ball = dcreg.SolveOptions(bound="ball")
found = dcreg.register(
    source, target, n_inliers=8, model="similarity2d", node_limit=100, options=ball
)
assert "ball" in dcreg.bound_names() and found.bound == "ball"

rigid = dcreg.SolveOptions(mode="rigid")
found = dcreg.register(
    source, target, n_inliers=8, model="similarity2d", scale_range=(1, 1), options=rigid
)
assert dcreg.mode_names("similarity2d") == ["paper", "rigid"]
assert (found.mode, found.status, found.certificate_scope) == ("rigid", "optimal", "rigid pose")
assert abs(found.scale - 1.0) < 1e-9

assert METRICS["median_error"].meaning.startswith("Median distance")
assert "noise_only" in [module.__name__.rpartition(".")[2] for module in modules(standalone)]
print("found all")
"""


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """A copy of the project with the files of the page."""
    folder = tmp_path_factory.mktemp("project")
    for name in PACKAGES:
        # The library with its compiled kernels, but without files that are being written: they stay
        # valid, because the files of the page have none.
        left = ("*.pyc*", "*.tmp.*") if name == "dcreg" else ("__pycache__",)
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns(*left))
    for name, content in FILES.items():
        path = folder / name
        assert not path.exists()
        path.parent.mkdir(exist_ok=True)
        path.write_text(content, encoding="utf-8")
    return folder


def test_page_shows_every_kind_of_addition():
    folders = {Path(name).parts[0] for name in FILES}
    assert folders == set(PACKAGES)
    assert len(FILES) == 9


@pytest.mark.parametrize("name", FILES)
def test_each_file_is_short(name):
    lines = [line for line in FILES[name].splitlines() if line.strip()]
    assert len(lines) <= MOST_LINES


def test_files_of_the_page_are_found(project):
    checked = subprocess.run(
        [sys.executable, "-c", CHECKS],
        cwd=project, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(project)},
    )  # fmt: skip
    assert checked.returncode == 0, checked.stderr
    assert checked.stdout.strip().endswith("found all")
