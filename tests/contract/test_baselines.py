"""Every folder in baselines/ keeps the rules of the contract; methods are found, not listed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from baselines import check, registry, template
from baselines.conformance import folder_rules, solve_rules
from baselines.conformance.candidate import Candidate, NotCheckedError

NAMES = registry.names(registry.ROOT)
PAIRS = [(name, model) for name in NAMES for model in registry.read_card(name).models]


@pytest.fixture(scope="module")
def candidates() -> dict[str, Candidate]:
    """One candidate per method, whose run is shared by the rules that only read it."""
    return {name: Candidate(name) for name in NAMES}


def obey(rule: Callable[..., None], *arguments: object) -> None:
    """Check a rule; skip what cannot be checked here."""
    try:
        rule(*arguments)
    except NotCheckedError as error:
        pytest.skip(str(error))


def test_the_first_set_of_methods_is_found() -> None:
    assert {"dcreg", "rpm_htb", "icp", "cpd", "teaserpp", "kiss_matcher"} <= set(NAMES)


@pytest.mark.parametrize("rule", folder_rules.RULES, ids=lambda rule: rule.__name__)
@pytest.mark.parametrize("name", NAMES)
def test_folder(candidates: dict[str, Candidate], name: str, rule: Callable) -> None:
    obey(rule, candidates[name])


@pytest.mark.usefixtures("thin_slices")
@pytest.mark.parametrize("rule", solve_rules.RULES, ids=lambda rule: rule.__name__)
@pytest.mark.parametrize(("name", "model"), PAIRS)
def test_solve(
    candidates: dict[str, Candidate], name: str, model: str, rule: Callable,
    request: pytest.FixtureRequest,
) -> None:  # fmt: skip
    if rule is solve_rules.stops_near_its_time_limit:
        request.getfixturevalue("processor_clock")
    obey(rule, candidates[name], model)


def test_the_template_keeps_every_rule_unchanged(tmp_path: Path) -> None:
    folder = template.new_baseline("my_method", root=tmp_path)
    assert sorted(path.name for path in folder.iterdir()) == ["adapter.py", "card.yaml"]
    (method,) = check.candidates(str(folder))
    found = list(check.results(method))
    assert [result for result in found if result[0] != check.OK] == []
    assert len(found) == len(folder_rules.RULES) + 2 * len(solve_rules.RULES)
    with pytest.raises(registry.BaselineError, match="exists already"):
        template.new_baseline("my_method", root=tmp_path)
