"""The registry's errors name place, value and remedy, and fingerprints follow the right files."""

from __future__ import annotations

import ast
import shutil
from pathlib import Path

import pytest
import yaml

from baselines import registry
from baselines.registry import BaselineError


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A folder of methods with one made from the template."""
    registry.new_baseline("mine", root=tmp_path)
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


def test_unknown_option_suggests_the_nearest() -> None:
    with pytest.raises(BaselineError, match=r"icp: unknown option 'start'; did you mean 'starts'"):
        registry.load("icp", start="multi")


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("icp", {"starts": "many"}, "identity, centroid, multi"),
        ("icp", {"max_iterations": "ten"}, "is a str; give a int such as the default 100"),
        ("icp", {"max_iterations": True}, "is a bool"),
        ("icp", {"trim": 1}, "is a int; give a bool"),
        ("cpd", {"w": 1.5}, r"w = 1\.5"),
        ("dcreg", {"bound": "papper"}, r"bound = 'papper'; choose from tight"),
        ("rpm_htb", {"bound": "paper"}, r"choose from termwise"),
        ("dcreg", {"mode": "quick"}, r"mode = 'quick'; choose one of \['full'"),
        ("kiss_matcher", {"front_end": "sift"}, "fpfh-mutual, norm-signature, all-pairs, oracle"),
    ],
)
def test_bad_option_value_is_explained(name: str, options: dict, words: str) -> None:
    with pytest.raises(BaselineError, match=words) as error:
        registry.load(name, **options)
    assert str(error.value).startswith(name)


def test_an_int_serves_as_a_float() -> None:
    assert registry.load("dcreg", gap_tol_factor=1).options["gap_tol_factor"] == 1


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        ({"color": "red"}, "field color"),
        ({"models": ["rigid2d"]}, r"field models\.0"),
        ({"licence": None}, "field licence"),
        ({"colour": "#123456"}, "field colour.*did you mean 'color'"),
    ],
)
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


def test_availability_has_a_row_per_method() -> None:
    rows = registry.availability()
    assert [row["name"] for row in rows] == registry.names()
    assert all(row["available"] or row["reason"] for row in rows)
    assert all(row["citation"] and row["version"] for row in rows)


@pytest.mark.parametrize("name", ["Mine", "_mine", "my-method", "", "../mine"])
def test_new_baseline_refuses_bad_names(tmp_path: Path, name: str) -> None:
    with pytest.raises(BaselineError, match="cannot name a method"):
        registry.new_baseline(name, root=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_new_baselines_get_colours_of_their_own(tmp_path: Path) -> None:
    for name in ("one", "two", "three"):
        registry.new_baseline(name, root=tmp_path)
    colors = {registry.read_card(name, tmp_path).color for name in registry.names(tmp_path)}
    assert len(colors) == 3
    assert "#000000" not in colors


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
        edit_card(root, color="#abcdef", summary="told otherwise", marker="x")
        assert registry.fingerprint("mine", root) == before
        edit_card(root, parameters={"move": False})
        assert registry.fingerprint("mine", root) != before

    def test_ignores_bytecode(self, root: Path) -> None:
        before = registry.fingerprint("mine", root)
        (root / "mine" / "__pycache__").mkdir()
        (root / "mine" / "__pycache__" / "adapter.pyc").write_bytes(b"0")
        assert registry.fingerprint("mine", root) == before

    def test_follows_what_it_depends_on(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Editing a kernel reruns the methods built on it and no other."""
        checkout = tmp_path / "checkout"
        shutil.copytree(
            registry.ROOT, checkout / "baselines", ignore=shutil.ignore_patterns("__pycache__")
        )
        shutil.copytree(
            registry.ROOT.parent / "dcreg", checkout / "dcreg",
            ignore=shutil.ignore_patterns("__pycache__"),
        )  # fmt: skip
        root = checkout / "baselines"
        monkeypatch.setattr(registry, "ROOT", root)
        before = {name: registry.fingerprint(name, root) for name in registry.names(root)}
        for file, expected in (
            ("bounds/dc.py", {"dcreg", "hbsp"}),
            ("kernels/termwise.py", {"dcreg", "rpm_htb", "rpm_bp", "hbsp"}),
        ):
            path = checkout / "dcreg" / file
            path.write_text(path.read_text() + "\n# edited\n")
            after = {name: registry.fingerprint(name, root) for name in before}
            assert {name for name in before if after[name] != before[name]} == expected
            before = after

    def test_unknown_dependence_is_an_error(self, root: Path) -> None:
        edit_card(root, depends=["dcreg/no_such_file.py"])
        with pytest.raises(BaselineError, match="field depends: 'dcreg/no_such_file"):
            registry.fingerprint("mine", root)


def library_imports(path: Path) -> set[Path]:
    """Files of ``dcreg`` that a file imports anywhere, directly."""
    checkout, found = registry.ROOT.parent, set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        modules = []
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            modules = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        for module in modules:
            if module.partition(".")[0] == "dcreg":
                stem = checkout.joinpath(*module.split("."))
                found |= {f for f in (stem.with_suffix(".py"), stem / "__init__.py") if f.is_file()}
    return found


@pytest.mark.parametrize(
    ("name", "never_reached"),
    [
        ("dcreg", {"sweeping.py"}),
        (
            "rpm_htb",
            {
                "bounds/dc.py", "bounds/edges.py", "bounds/shared.py", "certificate.py",
                "kernels/norm_bound.py", "kernels/rigid.py", "kernels/shared.py", "rigid.py",
                "sweeping.py",
            },
        ),
    ],
)  # fmt: skip
def test_search_methods_depend_on_all_they_import(name: str, never_reached: set[str]) -> None:
    """A new kernel or module of the library must enter the cards, or its edits rerun nothing."""
    library = registry.ROOT.parent / "dcreg"
    reached, todo = set(), [registry.ROOT / "_search.py"]
    while todo:
        new = library_imports(todo.pop()) - reached
        reached |= new
        todo += new
    depends = {
        path
        for entry in registry.read_card(name).depends
        for path in registry._depended(registry.ROOT / name, entry)
    }
    missing = {path.relative_to(library).as_posix() for path in reached - depends}
    assert missing - {"_version.py"} == never_reached
