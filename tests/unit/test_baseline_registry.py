"""The registry's errors name place, value and remedy, and fingerprints follow the right files."""

from __future__ import annotations

import ast
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml

from baselines import dependencies, registry, template
from baselines.contract import NOISE_FACTOR, Instance, ThresholdRule
from baselines.dependencies import files_behind
from baselines.registry import BaselineError


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Return a folder of methods with one from the template."""
    template.new_baseline("mine", root=tmp_path)
    return tmp_path


def edit_card(root: Path, **facts: object) -> None:
    path = root / "mine" / "card.yaml"
    card = yaml.safe_load(path.read_text())
    path.write_text(yaml.safe_dump({**card, **facts}))


def test_helpers_and_template_are_not_methods() -> None:
    assert not [name for name in registry.names() if name.startswith("_")]


def test_unknown_method_suggests_the_nearest() -> None:
    with pytest.raises(BaselineError, match="did you mean 'teaserpp'"):
        registry.load("teaserp")


SHARED = {"front_end": "shared-mutual"}
BAD_OPTIONS = [  # the contract tests try an unknown option and -1 with every method
    ("icp", {"start": "multi"}, "icp: unknown option 'start'; did you mean 'starts'"),
    ("icp", {"starts": "many"}, "identity, centroid, multi"),
    ("icp", {"max_iterations": "ten"}, "is a str; give a int such as the default 100"),
    ("icp", {"max_iterations": True}, "is a bool"),
    ("icp", {"max_iterations": 0}, "max_iterations = 0; give a finite number, at least 1$"),
    ("icp", {"max_iterations": None}, "max_iterations = None is a NoneType; give a int"),
    ("icp", {"trim": 1}, "is a int; give a bool"),
    ("cpd", {"w": 1.5}, r"w = 1\.5"),
    ("dcreg", {"bound": "tihgt"}, r"bound: 'tihgt' is unknown; did you mean 'tight'\?"),
    ("dcreg", {"bound": 3}, "bound: '3' is unknown"),
    ("dcreg", {"mode": "quick"}, "mode = 'quick'; known: auto, full, paper"),
    ("dcreg", {"mode": "full", "bound": "dc"}, "mode 'full' has its own bounds"),
    ("rpm_htb", {"bound": "dc"}, "known: termwise, termwise-r1"),
    ("rpm_htb", {"bound": "termwise-r1+interval"}, "bound = 'interval'; known: termwise, "),
    ("rpm_htb", {"bound": None}, "bound = 'None'; known: termwise, termwise-r1"),
    ("teaser", {"threshold": "paper", "noise_factor": 2.0},
     r"noise_factor = 2\.0 has no effect with threshold: paper; leave it out"),
    ("dcreg", {**SHARED, "bound": "tight"}, "no effect with a front_end"),
    ("dcreg", {**SHARED, "mode": "full"}, "no effect with a front_end"),
    ("dcreg", {**SHARED, "polish": False}, "no effect with a front_end"),
    ("dcreg", {**SHARED, "certify": False, "rel_gap": 0.1}, "no effect without bounds"),
    ("dcreg", {**SHARED, "score": "surfaces", "abs_gap": 0.1}, "no effect without bounds"),
    ("dcreg", {**SHARED, "score": "nonsense"}, "option score = 'nonsense'"),
    ("dcreg", {**SHARED, "score": "surfaces", "certify": True},
     "score = 'surfaces' has no bounds: leave certify out"),
    ("dcreg", {**SHARED, "certify": 1}, "certify = 1; give true, false or"),
    ("dcreg", {"certify": True}, "certify = True has no effect without a front_end; leave it"),
    ("dcreg", {"max_pairs": 500}, "max_pairs = 500 has no effect without a front_end"),
    ("dcreg", {"score": "surfaces"}, "score = 'surfaces' has no effect without a front_end"),
    ("dcreg", {"front_end": "oracle"}, "option front_end = 'oracle'"),
    ("dcreg", {"rel_gap": 1}, "rel_gap = 1; give a finite number, at least 0 and below 1$"),
    ("dcreg", {"abs_gap": -1}, "abs_gap = -1; give a finite number, at least 0$"),
    ("teaser", {"normal_radius": 2.0}, "no effect with front_end: norm-signature"),
    ("teaser", {"front_end": "oracle", "signature_neighbours": 2}, "with front_end: oracle"),
    ("teaser", {"front_end": "oracle", "oracle_outliers": 1.0}, "oracle_outliers = 1.0; give"),
    ("mac", {"compatibility_threshold": 0.9}, "no effect without a compatibility_width"),
    ("fpfh_fgr", {"tuple_test": False, "max_tuples": 5}, "no effect without the tuple_test"),
    ("small_gicp", {"variant": "ICP", "neighbours": 5}, "no effect with variant: ICP"),
    ("teaser", {"noise_factor": -1}, "noise_factor = -1; give a finite number, above 0$"),
    ("teaser", {"noise_factor": 0}, "noise_factor = 0; give"),
    ("teaser", {"noise_factor": float("nan")}, "noise_factor = nan; give a finite number"),
    ("ransac", {"confidence": 2}, "confidence = 2; give a finite number, above 0 and below 1$"),
    ("ransac", {"max_samples": 0}, "max_samples = 0; give"),
    ("goicp", {"translation_half_width": 0}, "give a finite number, above 0, or null$"),
    ("py_goicp", {"translation_half_width": None}, "is a NoneType; give a float"),
    ("frs", {"rotation_slack": 5}, "rotation_slack = 5; give"),
    ("mac", {"compatibility_width": 10, "compatibility_threshold": 7}, "threshold = 7; give"),
    ("mac", {"compatibility_width": True}, "compatibility_width = True is a bool; give a float"),
    ("icp_open3d", {"coarse_distances": [1.0, True]}, "is a list; give a list such as"),
    ("icp_open3d", {"coarse_distances": [1.0, -1]}, "give a finite number, above 0$"),
    ("teaser", {"threshold": "mine"}, "threshold = 'mine'; choose one of given, paper"),
    ("mac", {"threshold": "paper"}, "mac: unknown option 'threshold'"),
    ("kiss_matcher", {"front_end": "sift"}, "fpfh-mutual, norm-signature, all-pairs, oracle"),
    ("hunter", {"entry": "mine.py"}, "give module:function"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "options", "words"), BAD_OPTIONS)
def test_bad_option_value_is_explained(name: str, options: dict, words: str) -> None:
    with pytest.raises(BaselineError, match=words) as error:
        registry.load(name, **options)
    assert str(error.value).startswith(name)


@pytest.mark.parametrize("name", registry.names())
def test_a_threshold_of_the_paper_needs_a_stated_rule(name: str) -> None:
    card = registry.read_card(name)
    assert ("threshold" in card.parameters) == (card.threshold_rule is not None)


@pytest.mark.parametrize(
    ("name", "dim", "sigmas"),
    [("teaser", 3, 5.54), ("teaser", 2, 5.26), ("ransac", 2, 5.99**0.5), ("ransac", 3, 7.81**0.5)],
)
def test_a_tuned_threshold_is_the_papers_multiple_of_the_deviation(
    name: str, dim: int, sigmas: float
) -> None:
    model = "rigid3d" if dim == 3 else "similarity2d"
    points, deviation = np.eye(dim), 0.01
    bound = NOISE_FACTOR * deviation * np.sqrt(dim)  # of noise with this deviation per axis
    instance = Instance("i", points, points, model, dim, (1.0, 1.0), bound, 0)
    tuned = registry.load(name, threshold="paper").inlier_distance(instance)
    assert tuned == pytest.approx(sigmas * deviation, rel=1e-3)
    assert registry.load(name).inlier_distance(instance) == bound


@pytest.mark.parametrize(
    ("name", "deviation", "expected"),
    [("gore", 5.0, 0.75), ("frs", 0.01, 0.75), ("frs", 5.0, 15.0)],
)
def test_a_threshold_by_resolution_is_the_mean_spacing_of_both_clouds(
    name: str, deviation: float, expected: float
) -> None:
    source = np.indices((3, 3, 3)).reshape(3, -1).T.astype(float)  # a grid of spacing 1
    bound = NOISE_FACTOR * deviation * np.sqrt(3)
    instance = Instance("i", source, 0.5 * source, "rigid3d", 27, (1.0, 1.0), bound, 0)
    tuned = registry.load(name, threshold="paper").inlier_distance(instance)
    assert tuned == pytest.approx(expected, rel=1e-3)
    assert registry.load(name).inlier_distance(instance) == bound


def test_a_threshold_rule_states_a_length() -> None:
    with pytest.raises(ValueError, match="give confidence, spacings or both"):
        ThresholdRule(text="none", origin="ours")


def test_dcreg_leaves_mode_and_bound_to_the_library() -> None:
    """With an explicit bound the library does not choose modes that have their own bounds."""
    assert registry.load("dcreg").options["bound"] is None
    assert registry.load("dcreg").options["mode"] is None
    assert registry.load("dcreg", mode="full").options["bound"] is None


def test_null_is_for_options_that_admit_it() -> None:
    everywhere = registry.load("goicp", translation_half_width=None)
    assert everywhere.options["translation_half_width"] is None
    assert registry.load("cpd", w=None).options["w"] is None
    assert registry.load("cpd", w=0).options["w"] == 0  # an int serves as a float


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        ({"color": "red"}, "field color"),
        ({"models": ["rigid2d"]}, r"field models\.0"),
        ({"licence": None}, "field licence"),
        ({"colour": "#123456"}, "field colour.*did you mean 'color'"),
        ({"ranges": {"moves": {"least": 0}}}, r"ranges\.moves: no such parameter"),
        ({"ranges": {"move": {"from": 0}}}, r"field ranges\.move\.from"),
        ({"parameters": {"step": 0}, "ranges": {"step": {"above": 0}}},
         r"parameters\.step: 0 is not a finite number, above 0"),
    ],
)  # fmt: skip
def test_bad_card_names_file_and_field(root: Path, facts: dict, words: str) -> None:
    edit_card(root, **facts)
    with pytest.raises(BaselineError, match=words) as error:
        registry.load("mine", root=root)
    assert "card.yaml" in str(error.value)


def test_missing_field_and_files_are_named(root: Path) -> None:
    path = root / "mine" / "card.yaml"
    path.write_text(path.read_text().replace("citation: ", "# "))
    with pytest.raises(BaselineError, match=r"card\.yaml: field citation.*add it"):
        registry.load("mine", root=root)
    path.write_text("display_name: [")
    with pytest.raises(BaselineError, match="not valid YAML"):
        registry.load("mine", root=root)
    path.unlink()
    with pytest.raises(BaselineError, match=r"card\.yaml: missing"):
        registry.load("mine", root=root)


def test_adapter_without_the_class_is_named(root: Path) -> None:
    (root / "mine" / "adapter.py").write_text("Adapter = None\n")
    with pytest.raises(BaselineError, match=r"adapter\.py: no class Adapter"):
        registry.load("mine", root=root)


def test_missing_package_is_unavailable_with_remedy(root: Path) -> None:
    edit_card(root, requires="no_such_package_anywhere", how_to_get="pip install it")
    (row,) = registry.availability(root)
    assert row["available"] is False
    assert "no_such_package_anywhere" in row["reason"]
    assert row["reason"].endswith("pip install it")
    assert row["version"] == "not installed"


@pytest.mark.parametrize("text", ["import no_such_thing\n", "def f(:\n", "Adapter = x\n"])
def test_a_method_that_cannot_be_loaded_hides_no_others(root: Path, text: str) -> None:
    (root / "mine" / "adapter.py").write_text(text)
    (row,) = registry.availability(root)
    assert (row["name"], row["available"]) == ("mine", False)
    assert "Error: " in row["reason"]


def test_availability_has_a_row_per_method() -> None:
    rows = registry.availability()
    assert [row["name"] for row in rows] == registry.names()
    assert all(row["available"] or row["reason"] for row in rows)
    assert all(row["citation"] and row["version"] for row in rows)


@pytest.mark.parametrize("name", ["Mine", "_mine", "my-method", "", "../mine"])
def test_new_baseline_refuses_bad_names(tmp_path: Path, name: str) -> None:
    with pytest.raises(BaselineError, match="cannot name a method"):
        template.new_baseline(name, root=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_new_baseline_is_the_users_own_method_and_the_next_steps_name_its_files(
    root: Path,
) -> None:
    assert registry.read_card("mine", root).provenance == "own"
    files = "baselines/mine/adapter.py", "baselines/mine/card.yaml"
    for step in (*files, "-m baselines.check mine", "make run METHODS=mine,dcreg,icp"):
        assert step in template.next_steps("mine")
    elsewhere = template.next_steps("mine", root)
    for step in (f"-m baselines.check {root}/mine", f"DCREG_BASELINES_PATH={root}"):
        assert step in elsewhere


def test_new_baselines_get_colours_of_their_own(tmp_path: Path) -> None:
    for name in ("one", "two", "three"):
        template.new_baseline(name, root=tmp_path)
    colors = {registry.read_card(name, tmp_path).color for name in registry.names(tmp_path)}
    assert len(colors) == 3
    assert "#000000" not in colors


def output_of(script: str) -> str:
    """Return what a Python process in the checkout prints."""
    return subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True,
        cwd=registry.ROOT.parent,
    ).stdout  # fmt: skip


class TestFingerprint:
    def test_is_stable_and_differs_between_methods(self) -> None:
        prints = [registry.fingerprint(name) for name in registry.names()]
        assert prints == [registry.fingerprint(name) for name in registry.names()]
        assert len(set(prints)) == len(prints)

    def test_follows_the_adapter(self, root: Path) -> None:
        before = registry.fingerprint("mine", root)
        with (root / "mine" / "adapter.py").open("a") as stream:
            stream.write("\n# another line\n")
        assert registry.fingerprint("mine", root) != before

    def test_follows_the_defaults_but_not_the_looks(self, root: Path) -> None:
        before = registry.fingerprint("mine", root)
        edit_card(root, color="#abcdef", summary="another", marker="x", ranges={})
        assert registry.fingerprint("mine", root) == before
        edit_card(root, parameters={"move": False})
        assert registry.fingerprint("mine", root) != before

    def test_has_the_version_of_the_library_whose_search_it_uses(self) -> None:
        for name in ("rpm_htb", "rpm_bp", "hbsp"):
            own = registry.fingerprint(name)
            assert registry.fingerprint(name, options={"search": "own"}) == own
            with_library = registry.fingerprint(name, options={"search": "ours"})
            assert with_library == f"{own} + {registry.fingerprint('dcreg')}"

    def test_ignores_bytecode(self, root: Path) -> None:
        before = registry.fingerprint("mine", root)
        (root / "mine" / "__pycache__").mkdir()
        (root / "mine" / "__pycache__" / "adapter.pyc").write_bytes(b"0")
        assert registry.fingerprint("mine", root) == before


def test_all_modules_that_python_loads_count() -> None:
    """Every module of `baselines` that the import of a method loads is counted."""
    script = (
        "import sys, baselines.{0}.adapter\n"
        "of_methods = [m for name, m in sys.modules.items() if name.startswith('baselines')]\n"
        "print(*(m.__file__ for m in of_methods if m.__file__))"
    )
    for name in ("gore", "hbsp"):
        loaded = output_of(script.format(name)).split()
        assert set(loaded) <= set(map(str, registry.code_of(name)))
        assert str(registry.ROOT / name / "adapter.py") in loaded


def test_no_adapter_is_imported() -> None:
    script = (
        "import sys\n"
        "from baselines import registry\n"
        "prints = [registry.fingerprint(name) for name in registry.names()]\n"
        "print([name for name in sys.modules if name.endswith('.adapter')])\n"
    )
    assert output_of(script).strip() == "[]"


@pytest.fixture(scope="class")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Return a copy of the methods and the library, which the registry uses."""
    folder = tmp_path_factory.mktemp("checkout")
    for package in ("baselines", "dcreg"):
        shutil.copytree(
            registry.ROOT.parent / package, folder / package,
            ignore=shutil.ignore_patterns("__pycache__"),
        )  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "ROOT", folder / "baselines")
        yield folder


@pytest.fixture(scope="class")
def rerun_by(checkout: Path) -> Callable[..., set[str]]:
    """Return which methods have another fingerprint while `more` is at the end of a file."""
    root = checkout / "baselines"
    before = {name: registry.fingerprint(name, root) for name in registry.names(root)}

    def rerun_by(file: str, more: str = "\n# edited\n") -> set[str]:
        path = checkout / file
        text = path.read_text()
        path.write_text(text + more)
        stale = {name for name in before if registry.fingerprint(name, root) != before[name]}
        path.write_text(text)
        return stale

    return rerun_by


class TestWhatAMethodDependsOn:
    @pytest.mark.parametrize(
        ("file", "some", "others"),
        [
            # through the library's packages, two and more imports away; `dcreg.families.registry` finds
            # bounds by a pattern of file names, without an import
            ("dcreg/families/dc/bounds.py", {"dcreg", "rpm_htb", "hbsp"}, {"rpm_cav", "icp", "gore"}),
            ("dcreg/assignment/kernels/dense.py", {"dcreg", "rpm_bp", "rpm_cav"}, {"icp", "cpd", "dcp"}),
            ("dcreg/problem/geometry.py", {"dcreg", "rpm_cav", "teaser", "icp"}, set()),
            ("baselines/_shared/poses.py", {"icp", "gore", "teaserpp"}, {"rpm_htb"}),
            # imported within a function
            ("baselines/_shared/open3d_clouds.py", {"fpfh_ransac", "gore"}, {"icp", "goicp"}),
            # a child process
            ("baselines/_shared/learned_child.py", {"dcp", "dgr", "hunter"}, {"icp", "py_goicp"}),
            ("baselines/py_goicp/child.py", {"py_goicp"}, {"goicp", "dcp"}),
        ],
    )  # fmt: skip
    def test_an_edit_reruns_what_imports_the_file_and_no_other(
        self, rerun_by: Callable, file: str, some: set[str], others: set[str]
    ) -> None:
        stale = rerun_by(file)
        assert some <= stale
        assert not others & stale

    @pytest.mark.parametrize(
        "file", ["dcreg/cli/commands.py", "dcreg/plot/sweep.py", "baselines/registry.py"]
    )
    def test_files_that_no_solve_runs_do_not_count(self, rerun_by: Callable, file: str) -> None:
        assert rerun_by(file) == set()

    def test_a_data_file_of_the_folder_counts(self, checkout: Path, rerun_by: Callable) -> None:
        table = checkout / "baselines/icp/table.csv"
        table.touch()
        assert rerun_by("baselines/icp/table.csv", "1,2\n") == {"icp"}
        table.unlink()

    def test_the_library_as_a_whole_is_what_its_stub_names(self, checkout: Path) -> None:
        """Public names are loaded on first use; they stand in the stub, not in ``__init__``."""
        (checkout / "uses.py").write_text("import dcreg\n\ndcreg.register()\n")
        behind = files_behind([checkout / "uses.py"], checkout)
        found = {path.relative_to(checkout).as_posix() for path in behind}
        assert {"dcreg/__init__.pyi", "dcreg/families/dc/bounds.py", "dcreg/io/points.py"} <= found
        assert "dcreg/cli/commands.py" not in found

    def test_the_package_around_a_module_counts_without_its_imports(self, checkout: Path) -> None:
        (checkout / "uses.py").write_text("from dcreg.status import Status\n")
        behind = files_behind([checkout / "uses.py"], checkout)
        found = {path.relative_to(checkout).as_posix() for path in behind}
        assert found == {"uses.py", "dcreg/__init__.py", "dcreg/status.py"}

    def test_a_method_outside_the_checkout_may_import_its_own_files(
        self, checkout: Path, tmp_path_factory: pytest.TempPathFactory
    ) -> None:
        adapter = tmp_path_factory.mktemp("elsewhere") / "adapter.py"
        adapter.write_text("from . import helper\nfrom .helper import f\nimport dcreg.status\n")
        behind = files_behind([adapter], checkout)
        assert behind == {adapter, checkout / "dcreg/__init__.py", checkout / "dcreg/status.py"}

    def test_imports_for_type_checkers_do_not_count(self, checkout: Path) -> None:
        page = checkout / "dcreg/plot/page.py"
        for guard, counts in (("", True), ("if TYPE_CHECKING:\n    ", False)):
            (checkout / "uses.py").write_text(f"{guard}from dcreg.plot import page\n")
            assert (page in files_behind([checkout / "uses.py"], checkout)) == counts

    def test_a_file_is_parsed_once_and_again_after_an_edit(
        self, checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        parsed = []
        parse = ast.parse
        monkeypatch.setattr(ast, "parse", lambda *given: parsed.append(given[1]) or parse(*given))
        monkeypatch.setattr(dependencies, "_STORE", tmp_path / "imports.json")
        monkeypatch.setattr(sys, "dont_write_bytecode", False)
        monkeypatch.setattr(dependencies.atexit, "register", lambda *_: None)
        uses = checkout / "uses.py"

        def found_by_a_new_process() -> set[Path]:
            parsed.clear()
            dependencies._read.cache_clear()
            dependencies._stored.cache_clear()
            behind = files_behind([uses], checkout)
            dependencies._store(dependencies._stored(), 0)
            return behind

        (tmp_path / "imports.json").write_text("{damaged")
        uses.write_text("from dcreg.status import Status\n")
        before = found_by_a_new_process()
        assert str(uses) in parsed
        assert found_by_a_new_process() == before
        assert not parsed
        uses.write_text("from dcreg.names import MODELS\n")
        assert found_by_a_new_process() != before
        assert parsed[0] == str(uses)
        monkeypatch.setattr(dependencies, "_version", lambda: "other code")
        found_by_a_new_process()
        assert str(uses) in parsed
        dependencies._read.cache_clear()
        dependencies._stored.cache_clear()
