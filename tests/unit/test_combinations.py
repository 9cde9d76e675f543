"""Which questions work with which model, mode and option; and what the program says where they do not."""

import re
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "docs" / "_extensions"))
try:
    import combinations
finally:
    sys.path.pop(0)


@pytest.fixture(scope="module")
def refusals():
    return combinations.refusals()


def proposals(cell, message):
    """The combinations that a message proposes."""
    for question in re.findall(r"`dcreg ([a-z-]+)`", message):
        if question in combinations.questions() and question != cell.question:
            yield cell._replace(question=question)
    if re.search(r"omit --mode", message):
        yield cell._replace(mode="full")
    option = re.escape(cell.option.strip("-"))
    if re.search(rf"omit (--)?{option}|or omit .*certificate|no {option}|leave it out", message):
        yield cell._replace(option=combinations.NO_OPTION)
    if re.search(r"give (a|the) number", message):
        yield cell._replace(option=combinations.NO_OPTION)
    for mode in re.findall(r"use mode '(\w+)'", message):
        yield cell._replace(mode=mode)
    for model in re.findall(r"use (?:model )?(rigid3d|similarity\dd)", message):
        yield cell._replace(model=model)


def starts(cell, refusals, steps):
    """Whether what the messages propose leads to a search."""
    if not (message := refusals.get(cell, "unknown mode")):
        return True
    return steps > 0 and any(starts(each, refusals, steps - 1) for each in proposals(cell, message))


def test_a_message_about_a_combination_names_one_that_works(refusals):
    """If the question does not work with the mode either, a second message may follow."""
    refused = {cell: message for cell, message in refusals.items() if message}
    plain = {cell: cell._replace(option=combinations.NO_OPTION) for cell in refused}
    assert refused
    lost = {
        cell: message
        for cell, message in refused.items()
        if not starts(cell, refusals, 1 + (cell != plain[cell] in refused))
    }
    assert not lost


def test_two_thirds_of_the_cells_work():
    cells = combinations.cells()
    assert len(cells) >= 100
    assert sum(cells) / len(cells) >= 2 / 3


def test_the_tables_have_every_question_mode_and_option():
    text = combinations.tables()
    for name in (*combinations.questions(), *combinations.OPTIONS):
        assert name in (combinations.NO_OPTION, combinations.NO_NUMBER) or f"| `{name}` |" in text
    assert f"{sum(combinations.cells())} of the {len(combinations.cells())} cells" in text
    assert re.search(r"^\| `register` \| yes \| yes \| yes \| yes \|$", text, re.M)


@pytest.mark.parametrize(
    ("cell", "words"),
    [
        (("sweep", "rigid3d", "full", "--max-rms"), "omit --max-rms, or use `dcreg register`"),
        (
            ("alternatives", "rigid3d", "full", "--source-weights"),
            "use `dcreg register`, `dcreg sweep` or `dcreg certify`$",
        ),
        (("register", "similarity3d", "full", "--axis"), "--axis: not supported by similarity3d;"),
        (("register", "rigid3d", "paper", "--source-weights"), "in mode 'paper'; use mode 'full'$"),
        (
            ("register", "similarity2d", "paper", "--axis"),
            "--axis: only rigid3d has an axis; omit --axis,",
        ),
    ],
)
def test_messages(refusals, cell, words):
    assert re.search(words, refusals[combinations.Combination(*cell)])
