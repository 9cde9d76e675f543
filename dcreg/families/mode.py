"""The modes that the families offer: what `dcreg.register` can search, and by which bounds.

A file ``mode_MODEL_NAME.py`` in the folder of a family adds mode ``NAME`` to the model ``MODEL``. Its
`MODE` states the space and the bound. Several models may have a mode of the same name.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from dcreg.names import DEFAULT_BOUND, mode_files
from dcreg.search import Bound, Outcome
from dcreg.search.space_search import Cover

# (source, target, n_inliers, candidates, tolerance=, threads=, budget=) -> the best rotation about the
# origin
RotationSearch = Callable[..., Outcome]


@dataclass(frozen=True)
class Mode:
    """A method to solve the problems of one model.

    Attributes
    ----------
    summary : str
        One line for help texts and manuals.
    space : callable
        The space of the certified search, from ``(source, target, n_inliers, *needs, candidates,
        stop_flag, stationary_box)``.
    needs : tuple of str
        More fields of the problem that the space needs, such as ``scale_range``.
    make_bound : callable, optional
        The mode's own bound, from ``(space, threads=...)``. None: the user chooses it by name.
    make_cover : callable, optional
        From ``(space, threads)`` to the `Cover` that confines a long search; called only where one is
        needed.
    own_bound : str
        Name of the bound if the user does not choose one.
    rotation : callable, optional
        The rotation search that follows a search over translations.
    rotation_scope : str
        If given, the bounds of the result are those of the rotation search, and this is their scope.
    in_norm_space : bool
        Whether the bounds refer to norms, not to the residuals of a pose.
    certifies : str
        Family of the certificate that the search can record (``dcreg.certificate.format.MODELS``), or
        empty.
    in_region : callable, optional
        The space of the poses in a ``region=`` (``dcreg.families.region``), otherwise like `space`, and
        its bound like `make_bound`, or None if the user chooses it. Returned by a function without
        arguments, so that they are imported only if needed. None: only all poses can be searched.
    stage : str
        Name of the certified search in events and stages.
    name, model : str
        Those of the file.
    """

    summary: str
    space: Callable[..., Any]
    needs: tuple[str, ...] = ()
    make_bound: Callable[..., Bound] | None = None
    make_cover: Callable[..., Cover] | None = None
    own_bound: str = DEFAULT_BOUND
    rotation: RotationSearch | None = None
    rotation_scope: str = ""
    in_norm_space: bool = False
    certifies: str = ""
    in_region: Callable[[], tuple[Callable[..., Any], Callable[..., Bound] | None]] | None = None
    stage: str = "search"
    name: str = ""
    model: str = ""


@functools.cache
def all_modes() -> tuple[Mode, ...]:
    """Return the modes of all families."""
    return tuple(load_mode(*key) for key in mode_files())


@functools.cache
def load_mode(model: str, name: str) -> Mode:
    """Return a mode that is among `mode_files`; other modes are not imported."""
    path = mode_files()[model, name]
    module = importlib.import_module(f"{__package__}.{path.parent.name}.{path.stem}")
    return replace(module.MODE, name=name, model=model)
