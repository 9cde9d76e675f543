"""Write the files of all problems: ``python -m workflows.library generate``."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from data.library.problem import PROBLEMS, Problem, Truth, write_problem
from data.library.recipe import Recipe
from data.registry import dataset
from dcreg.certificate.format import digest
from workflows.library.constructions import constructed
from workflows.library.draft import Draft
from workflows.library.paper import generated

SCANS = ("bunny", "dino", "horse")
RECIPES = [
    *(Recipe(dataset=name, shape=name, n_points=n) for name in SCANS for n in (60, 100)),
    *(
        Recipe(dataset="chui_rangarajan", shape=shape, test=test, level=level)
        for shape in ("fish", "character")
        for test, level in (("def", 5), ("noise", 3), ("outlier", 3), ("rot", 4))
    ),
    Recipe(dataset="small_gicp", shape="street", test="pair", n_points=100),
]


def public() -> Iterator[Draft]:
    """Yield the problems over third-party data, which need their files."""
    for recipe in RECIPES:
        raw, card = recipe.instance(), dataset(recipe.dataset).card
        parts = [recipe.dataset.replace("_", "-")]
        parts += [] if recipe.shape == recipe.dataset else [recipe.shape]
        if recipe.test and recipe.test != "pair":
            parts += [recipe.test, f"{recipe.level:g}"]
        parts += [] if recipe.n_points is None else [str(recipe.n_points)]
        title = f"{card.title}, {recipe.shape}"
        yield Draft(
            "-".join(parts), "public", title, f"recipe; cite {card.citation}", raw.source, raw.target,
            raw.pairs, len(raw.pairs), unit="that of the data", scale_range=raw.scale_range,
            recipe=recipe.model_dump(),
        )  # fmt: skip


def as_problem(draft: Draft) -> Problem:
    """Return the problem of a draft, version 1."""
    third_party = bool(draft.recipe)
    points = (
        {} if third_party else {"source": draft.source.tolist(), "target": draft.target.tolist()}
    )
    licence = dataset(draft.recipe["dataset"]).card.licence if third_party else "MIT"
    return Problem.model_validate(
        {
            "name": draft.name, "version": 1, "family": draft.family, "title": draft.title,
            "origin": draft.origin, "licence": licence, "unit": draft.unit, "model": draft.model,
            "n_inliers": draft.n_inliers, "scale_range": draft.scale_range,
            "n_source": len(draft.source), "n_target": len(draft.target),
            "source_sha256": digest(draft.source), "target_sha256": digest(draft.target),
            "planted_optima": draft.planted_optima,
            "truth": Truth(pose=draft.truth().tolist(), pairs=draft.pairs.tolist()),
            "recipe": draft.recipe or None, **points,
        }
    )  # fmt: skip


def generate(folder: Path = PROBLEMS, *, with_public: bool = True) -> list[Path]:
    """Write all problems; existing files stay as they are.

    Raises
    ------
    LibraryError
        If a construction gives a problem that differs from the file of the same name and version.
    """
    folder.mkdir(parents=True, exist_ok=True)
    drafts = chain(generated(), constructed(), public() if with_public else ())
    return [write_problem(as_problem(draft), folder) for draft in drafts]
