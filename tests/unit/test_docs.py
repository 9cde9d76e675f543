"""The promises of README, documentation, Makefile, lock files and project files."""

import json
import re
import subprocess
import sys
import tomllib
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

import dcreg
from docs import figures

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
DOCS = ROOT / "docs"
PAGES = sorted(
    [*ROOT.glob("*.md"), *(path for path in DOCS.rglob("*.md") if "images" not in path.parts)]
)
MOST_WORDS = 900


def text_of(path: Path) -> str:
    return path.read_text(encoding="utf-8")


# --- the documentation --------------------------------------------------------------------------


def test_documentation_builds_without_a_warning(tmp_path):
    """Offline. Unknown references and broken links between pages are warnings."""
    built = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html",
         str(DOCS), str(tmp_path)],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    bounds = text_of(tmp_path / "bounds.html")
    assert "<math" in bounds
    assert "\\frac" not in bounds
    for page in tmp_path.glob("*.html"):
        loaded = re.findall(
            r'<(?:script|img|link)[^>]*(?:src|href)="(https?:[^"]+)"', text_of(page)
        )
        assert not loaded, f"{page.name} needs a network"


def test_readme_and_limits_name_every_reconstruction():
    from baselines import registry

    cards = {name: registry.read_card(name) for name in registry.names()}
    for name, card in cards.items():
        if card.provenance == "reconstruction":
            assert card.display_name.removesuffix(" (reconstructed)") in text_of(README)
            assert f"`{name}`" in text_of(DOCS / "limits.md")


def anchors(path: Path) -> set[str]:
    """Anchors of a page: its headings as GitHub names them, and its labels."""
    text = re.sub(r"^```.*?^```", "", text_of(path), flags=re.M | re.S)
    headings = re.findall(r"^#+ (.*)$", text, re.M)
    slugs = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
    return slugs | set(re.findall(r"^\((.*)\)=$", text, re.M))


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_relative_links_have_a_target(page):
    text = text_of(page)
    links = re.findall(r"\]\(([^)\s]+)\)", text)
    links += re.findall(r'(?:src|srcset)="([^"]+)"', text)
    for link in links:
        if re.match(r"[a-z]+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name) if name else page
        assert target.exists(), f"{page.name}: {link}"
        if anchor:
            assert anchor in anchors(target), f"{page.name}: {link}"


def test_paths_named_in_code_spans_exist():
    folders = "dcreg|baselines|data|workflows|reports|tests|examples|docs"
    named = {
        (page.name, path)
        for page in PAGES
        if page.name != "CHANGELOG.md"
        for path in re.findall(rf"`((?:{folders})/[\w./-]*)`", text_of(page))
    }
    assert len(named) > 30
    assert not [entry for entry in named if not (ROOT / entry[1]).exists()]


def test_every_public_name_is_in_the_reference():
    reference = text_of(DOCS / "api.md")
    # a module by what it holds
    assert not [n for n in dcreg.__all__ if not re.search(rf"dcreg\.{n}[.\n]", reference)]


@pytest.mark.parametrize(
    "name", [name for name in dcreg.__all__ if name not in ("Candidates", "Listener")]
)
def test_every_public_name_has_its_own_docstring(name):
    documented = (getattr(dcreg, name).__doc__ or "").strip()
    assert len(documented) > 20
    assert not documented.startswith(f"{name}(")  # the default of a dataclass


def test_every_json_key_is_documented():
    points = [[0.0, 0.0], [1.0, 0.0], [0.0, 2.0]]
    result = dcreg.register(points, points, n_inliers=3, model="similarity2d")
    table = text_of(DOCS / "results.md").partition("## JSON keys")[2].partition("\n## ")[0]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    assert set(re.findall(r"`(\w+)`", " ".join(rows))) == result.to_dict().keys()


def test_attributes_of_answers_are_keys_of_their_json():
    points, T = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 2.0]]), np.eye(3)
    given = {"n_inliers": 3, "model": "similarity2d"}
    answers = [
        dcreg.certify(points, points, T, **given), dcreg.alternatives(points, points, **given),
        dcreg.max_inliers(points, points, distance=0.1, model="similarity2d"), dcreg.Report(),
    ]  # fmt: skip
    for answer in answers:
        assert {field.name for field in fields(answer)} <= answer.to_dict().keys()


def test_every_bound_and_status_is_documented():
    from dcreg.names import bound_names

    bounds, results = text_of(DOCS / "bounds.md"), text_of(DOCS / "results.md")
    assert not [name for name in bound_names() if f"`{name}`" not in bounds]
    ended = [status for status in dcreg.Status if status is not dcreg.Status.NOT_RUN]
    assert not [status for status in ended if f"`{status}`" not in results]


# --- README ------------------------------------------------------------------------------------


def test_readme_is_short():
    assert len(text_of(README).split()) <= MOST_WORDS


def test_python_of_the_readme_runs(capsys):
    (block,) = re.findall(r"^```python\n(.*?)^```", text_of(README), re.M | re.S)
    statements = [line for line in block.splitlines() if line.strip()]
    assert len(statements) <= 10
    names: dict = {}
    exec(compile(block, "README.md", "exec"), names)
    assert names["result"].status == "optimal"
    assert "similarity pose" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["make demo", "make test"])
def test_readme_shows_the_two_commands(command):
    """In the first code block, where a new reader looks first."""
    first = re.search(r"^```.*?^```", text_of(README), re.M | re.S)
    assert command in first.group()


def test_readme_shows_the_table_of_the_recorded_run():
    assert text_of(DOCS / "images" / "runs.md").strip() in text_of(README)


@pytest.mark.parametrize("bound", ["tight", "dc"])
def test_the_table_of_the_readme_has_the_present_counters(bound):
    """If this fails: `python -m docs.figures`."""
    result = figures.solve_ours(figures.instance(figures.POINTS, figures.LEVEL), bound, 600.0)
    (row,) = re.findall(rf"^\| {re.escape(figures.NAMES[bound])} .*$", text_of(README), re.M)
    shown = [int(cell.replace(",", "")) for cell in row.split(" | ")[4:6]]
    # rounding differs between machines
    assert [result.n_nodes, result.n_assignments] == pytest.approx(shown, rel=0.01)


def test_pictures_are_small_and_for_both_themes():
    pictures = sorted((DOCS / "images").glob("*.svg"))
    assert {path.stem.rpartition("-")[2] for path in pictures} == {"light", "dark"}
    assert not [path for path in pictures if path.stat().st_size > 200_000]


def test_script_of_the_pictures_runs(tmp_path):
    subprocess.run(
        [sys.executable, "-m", "docs.figures", "--folder", str(tmp_path), "--points", "20",
         "--time-limit", "1"],
        cwd=ROOT, check=True, capture_output=True,
    )  # fmt: skip
    names = {path.name for path in (DOCS / "images").iterdir()}
    assert {path.name for path in tmp_path.iterdir()} == names
    assert "`optimal`" in text_of(tmp_path / "runs.md")


# --- Makefile, lock file, project files ---------------------------------------------------------


def declared_targets() -> set[str]:
    """Phony targets of the Makefile: what a person may call."""
    text = text_of(ROOT / "Makefile")
    return {name for line in re.findall(r"^\.PHONY:(.*)$", text, re.M) for name in line.split()}


def helped_targets() -> set[str]:
    shown = subprocess.run(
        ["make", "--no-print-directory", "help"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return set(re.findall(r"^\s*make ([a-z0-9-]+)", shown.stdout, re.M))


def named_targets(page: Path) -> set[str]:
    """Targets in the code of a page: `make x` in a code span, or at the start of a line of a block."""
    text = text_of(page)
    code = re.findall(r"^(?: {4}|\s*[$] )?make ([a-z0-9-]+)", text, re.M)
    return {*code, *re.findall(r"`(?:[A-Z_]+=\S+ )*make ([a-z0-9-]+)", text)}


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_pages_name_only_targets_that_exist(page):
    assert named_targets(page) <= declared_targets()


def test_contributing_names_every_folder_of_tests():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    folders = {file.parent.name for file in (ROOT / "tests").glob("*/*.py")}
    assert folders == set(re.findall(r"^\| `tests/([a-z_]+)`", text, re.M))


def test_needs_are_counted_by_how_far_they_are_met():
    text = (DOCS / "questions.md").read_text(encoding="utf-8")
    _, _, table = text.partition("| need | asked for | answer | limits | met |\n")
    rows = re.findall(r"^\| .+ \| .+ \| .+ \|.* \| (yes|partly|no) \|$", table, re.M)
    yes, partly, no = (rows.count(met) for met in ("yes", "partly", "no"))
    assert f"these {len(rows)} needs" in text
    assert len(rows) == 27
    assert f"{yes} needs have an answer, {partly} have part of one and {no} has none" in text


def test_make_help_lists_the_documented_targets():
    """The table is generated from the Makefile; helpers that `help` hides are not public."""
    sys.path.insert(0, str(DOCS / "_extensions"))
    try:
        from listings import targets
    finally:
        sys.path.pop(0)
    listed = set(re.findall(r"`make ([a-z0-9-]+)`", targets()))
    assert listed == helped_targets()
    assert named_targets(README) <= listed
    assert listed <= declared_targets()


LOCKS = sorted(path.name for path in ROOT.glob("requirements*.lock"))


@pytest.mark.parametrize("name", LOCKS)
def test_lock_files_pin_versions_with_hashes_and_name_no_host(name):
    text = text_of(ROOT / name)
    assert not re.search(r"://|index| @ |^-", text, re.M)
    packages = re.split(r"^(?=[^ ])", text, flags=re.M)[1:]
    entry = re.compile(r"[a-z0-9-]+==\S+( ; [^\\]+)?( \\\n    --hash=sha256:[0-9a-f]{64})+\n")
    assert packages
    assert not [package for package in packages if not entry.fullmatch(package)]


def test_every_installation_of_a_lock_file_checks_the_hashes():
    scripts = [ROOT / "Makefile", *(ROOT / "workflows").glob("*.sh")]
    text = "".join(text_of(path).replace("\\\n", "") for path in scripts)
    lines = [line for line in text.splitlines() if re.search(r"--requirement \S+\.lock", line)]
    installed = {name for line in lines if "install" in line for name in LOCKS if name in line}
    assert {"requirements.lock", "requirements-dev.lock"} <= installed
    assert not [line for line in lines if "install" in line and "--require-hashes" not in line]


def direct_dependencies() -> set[str]:
    project = tomllib.loads(text_of(ROOT / "pyproject.toml"))["project"]
    wanted = sum(project["optional-dependencies"].values(), project["dependencies"])
    return {re.match(r"[\w.-]+", entry).group().lower() for entry in wanted} - {"dcreg"}


def test_lock_files_pin_every_direct_dependency():
    lines = "\n".join(text_of(path) for path in ROOT.glob("requirements*.lock"))
    pinned = {name.lower().replace("_", "-") for name in re.findall(r"^([\w.-]+)==", lines, re.M)}
    assert not {name.replace("_", "-") for name in direct_dependencies()} - pinned


def test_notices_name_every_direct_dependency():
    names = direct_dependencies()
    rows = re.findall(r"^\| ([\w.-]+) \|", text_of(ROOT / "THIRD_PARTY_NOTICES.md"), re.M)
    rows = [row for row in rows if row != "package"]
    assert len(names) > 20
    assert names == {row.lower() for row in rows}


def test_version_changelog_and_citation_agree():
    import yaml

    version, date = re.search(
        r"^## (\S+) \((\S+)\)$", text_of(ROOT / "CHANGELOG.md"), re.M
    ).groups()
    assert version == dcreg.__version__
    citation = yaml.safe_load(text_of(ROOT / "CITATION.cff"))
    assert (citation["version"], citation["date-released"]) == (version, date)
    assert citation["license"] == "MIT"
    assert "arXiv:2603.25442" in json.dumps(citation["references"])


def test_changelog_is_short():
    """At most 40 entries per release, each of one sentence or two."""
    for release in re.split(r"^## ", text_of(ROOT / "CHANGELOG.md"), flags=re.M)[1:]:
        entries = re.findall(r"^- .*(?:\n  .*)*", release, re.M)
        assert len(entries) <= 40
        assert not [entry for entry in entries if len(entry.split()) > 40]
