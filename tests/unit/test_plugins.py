"""Methods, datasets and metrics of other packages are found by entry points, and break nothing else."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from baselines import check, registry
from baselines.registry import BaselineError
from data import registry as datasets
from data.contract import DataError
from dcreg.plugins import Plugin, PluginError, files_of, plugins
from workflows.disturb import make_instance
from workflows.stages.generate import sources_digest

CHECKOUT = Path(__file__).parents[2]
EXAMPLE = CHECKOUT / "examples" / "plugin"


def install(folder: Path, name: str, points: dict[str, dict[str, str]]) -> None:
    """Write what an installer writes: the metadata of a package with entry points."""
    place = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    place.mkdir()
    (place / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    lines = [
        line
        for group, entries in points.items()
        for line in (f"[{group}]", *(f"{key} = {value}" for key, value in entries.items()))
    ]
    (place / "entry_points.txt").write_text("\n".join(lines) + "\n")


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder on the path in which packages are installed."""
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


@pytest.fixture
def example(site: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Install the example; its code is found in its folder."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    install(site, project["name"], project["entry-points"])
    monkeypatch.syspath_prepend(str(EXAMPLE))
    return site


def added(site: Path, files: dict[str, str], name: str = "mine") -> None:
    """Install a package that adds the method `name`, with these files."""
    folder = site / "my_package"
    folder.mkdir()
    for file, text in {"__init__.py": "", **files}.items():
        (folder / file).write_text(text)
    install(site, "my-package", {registry.GROUP: {name: "my_package"}})


def test_the_method_of_the_example_keeps_every_rule(
    example: Path, capsys: pytest.CaptureFixture
) -> None:
    assert "principal_axes" in registry.names()
    assert registry.facts("principal_axes")["version"] == "1.0"  # of the package
    assert check.main(["dcreg-example-plugin"]) == 0
    printed = capsys.readouterr().out
    assert "principal_axes: package dcreg-example-plugin 1.0 (entry point principal_a" in printed
    assert "29 rules kept, 0 broken, 0 not checked" in printed
    (found,) = check.candidates(str(EXAMPLE))
    assert found.name == "principal_axes"


def test_its_dataset_is_found_and_its_files_decide_the_instances(
    example: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spiral = datasets.dataset("spiral")
    assert make_instance(spiral, "spiral", "noise", 0.01, 0, n_points=12).source.shape == (12, 2)
    files, before = datasets.files_of("spiral"), sources_digest(["spiral"])
    loader = EXAMPLE / "dcreg_example" / "spiral" / "loader.py"
    assert loader in files
    assert sources_digest(["spiral"]) == before
    changed = tmp_path / "loader.py"
    changed.write_text(f"{loader.read_text()}\n")
    others = [changed if path == loader else path for path in files]
    monkeypatch.setattr(datasets, "files_of", lambda name: others)
    assert sources_digest(["spiral"]) != before


def test_its_metric_becomes_a_column(example: Path) -> None:
    code = (
        f"import sys; sys.path[:0] = [{str(EXAMPLE)!r}, {str(example)!r}]\n"
        "from workflows.metrics import METRICS, BROKEN\n"
        "from workflows.records import runs_columns\n"
        "assert not BROKEN and METRICS['example_median_error'].is_added\n"
        "assert runs_columns()['example_median_error'].is_added\n"
        "assert not METRICS['rmse'].is_added\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=CHECKOUT)


def test_the_hash_of_a_method_follows_all_files_of_its_package(
    site: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    card = (EXAMPLE / "dcreg_example" / "principal_axes" / "card.yaml").read_text()
    added(site, {"card.yaml": card, "adapter.py": "from my_package.core import Adapter\n"})
    core = site / "my_package" / "core.py"
    core.write_text("Adapter = 1\n")
    before = registry.fingerprint("mine")
    assert core in registry.code_of("mine")
    core.write_text("Adapter = 2\n")
    assert registry.fingerprint("mine") != before
    assert registry.origin_of("mine").startswith("package my-package 1.0 (entry point mine = my_")


def test_a_method_cannot_take_the_name_of_another(site: Path) -> None:
    added(site, {}, name="icp")
    for ask in (registry.load, registry.read_card, registry.fingerprint):
        with pytest.raises(
            BaselineError, match="'icp' is defined twice: by baselines/icp and by pack"
        ):
            ask("icp")
    assert "my-package 1.0 (entry point icp = my_package" in registry.facts("icp")["reason"]
    assert registry.facts("cpd")["available"]


BROKEN = {
    "no package": ({}, "other_package", "there is no package other_package; correct the entry"),
    "no card": ({"adapter.py": ""}, "my_package", "card.yaml: missing"),
    "no class": ({"adapter.py": "", "card.yaml": "CARD"}, "my_package", "no class Adapter"),
    "raises": (
        {"adapter.py": "1 / 0", "card.yaml": "CARD"},
        "my_package",
        "ZeroDivisionError: div",
    ),
    "imports": (
        {"adapter.py": "import nothing_here", "card.yaml": "CARD"},
        "my_package",
        "nothing_h",
    ),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_method_is_unavailable_and_breaks_nothing_else(site: Path, kind: str) -> None:
    files, module, reason = BROKEN[kind]
    package = f"package_{kind.replace(' ', '_')}"  # Python keeps what it has imported
    card = (EXAMPLE / "dcreg_example" / "principal_axes" / "card.yaml").read_text()
    (site / package).mkdir()
    for file, text in {"__init__.py": "", **files}.items():
        (site / package / file).write_text(text.replace("CARD", card))
    module = module.replace("my_package", package)
    install(site, "broken", {registry.GROUP: {"mine": module}})
    mine = registry.facts("mine")
    assert (mine["available"], registry.facts("icp")["available"]) == (False, True)
    assert reason in mine["reason"]
    assert check.main(["broken"]) == 1


def test_a_dataset_cannot_take_the_name_of_another(site: Path) -> None:
    install(site, "their-data", {datasets.GROUP: {"embedded": "x", "gone": "no_such_package"}})
    with pytest.raises(DataError, match=r"twice: by data/embedded and by package their-data 1\.0"):
        datasets.dataset("embedded")
    with pytest.raises(DataError, match=r"entry point gone .*there is no package no_such_package"):
        datasets.dataset("gone")
    assert datasets.dataset("pycpd_fish").card.name == "pycpd_fish"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("raise OSError('no disk')", "OSError: no disk"),
        (
            "from workflows.metrics import metric\n@metric('1', 'none')\ndef half(case): ...\n"
            "@metric('1', 'none')\ndef rmse(case): ...\n",
            "'rmse' is defined twice: by workflows.metrics.errors and by their_metrics",
        ),
    ],
)
def test_broken_metrics_are_left_out_with_their_reason(site: Path, text: str, reason: str) -> None:
    (site / "their_metrics.py").write_text(text)
    install(site, "their-metrics", {"dcreg.metrics": {"theirs": "their_metrics"}})
    code = (
        f"import sys; sys.path[:0] = [{str(site)!r}]\n"
        "from workflows.metrics import METRICS, BROKEN\n"
        "assert 'half' not in METRICS and METRICS['rmse'].module == 'workflows.metrics.errors'\n"
        "print(BROKEN)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, cwd=CHECKOUT, capture_output=True, text=True
    )
    assert reason in done.stdout
    assert "package their-metrics 1.0 (entry point theirs" in done.stdout


def test_what_is_no_method_is_an_error_with_the_remedy(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert check.main(["no_such_thing"]) == 2
    assert "neither a method, nor a folder, nor an installed package" in capsys.readouterr().err
    assert check.main([str(tmp_path)]) == 2
    assert "no card.yaml and adapter.py here" in capsys.readouterr().err
    (tmp_path / "pyproject.toml").touch()
    assert check.main([str(tmp_path)]) == 2
    assert "not installed in editable mode; run" in capsys.readouterr().err


def test_files_of_a_plugin_that_is_a_single_module(site: Path) -> None:
    (site / "alone.py").touch()
    plugin = Plugin("a", "alone", "p", "package p")
    assert files_of(plugin) == [site / "alone.py"]
    missing = Plugin("a", "alone.inner", "p", "package p")
    with pytest.raises(PluginError, match="package p: there is no package alone"):
        _ = missing.files
    assert files_of(missing) == []
    assert plugins("no.such.group") == []
