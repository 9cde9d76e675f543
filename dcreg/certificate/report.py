"""The outcome of `verify`: its text, its JSON and the stated pose for a figure."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from dcreg.answer import Answer
from dcreg.certificate.format import Certificate
from dcreg.certificate.vectors import matrices
from dcreg.files import plain


@dataclass(repr=False)
class Report(Answer):
    """The outcome of `verify`. Bounds are in squared units of the target, as in `dcreg.Result`.

    Attributes
    ----------
    accepted : bool
    is_certificate : bool
        False if there was nothing to check: no file, or a file that is not a certificate.
    reason : str
        Why the certificate was rejected; empty if it was accepted.
    statement : str
        What is proven; empty if the certificate was rejected.
    is_trivial : bool
        Whether the lower bound is 0, which holds for any sum of squares, and the upper bound is not 0.
    checks : list of str
        One line for each check passed.
    model : str
        Family of poses that the certificate refers to.
    n_inliers : int
    T_target_source : (d+1, d+1) array, optional
        The stated pose, if it attains the upper bound; None in norm space (model ``translation3d``).
    lower_bound, upper_bound, gap_tol : float
        As stated by the certificate; proven only if it was accepted. If the stated lower bound takes too
        many boxes, ``lower_bound`` is ``upper_bound - gap_tol``, and a line of ``checks`` says so.
    n_leaves, n_boxes, n_assignments : int
        Leaves of the certificate, boxes bounded for the proof, assignments solved.
    time_s : float
        Wall time of the check.
    """

    accepted: bool = False
    is_certificate: bool = True
    reason: str = ""
    statement: str = ""
    is_trivial: bool = False
    checks: list[str] = field(default_factory=list)
    model: str = ""
    n_inliers: int = 0
    T_target_source: np.ndarray | None = None
    lower_bound: float = np.nan
    upper_bound: float = np.nan
    gap_tol: float = np.nan
    n_leaves: int = 0
    n_boxes: int = 0
    n_assignments: int = 0
    time_s: float = 0.0

    question = "certificate"

    @property
    def verdict(self) -> str:
        """``proven``, ``trivial``, ``rejected``, or ``no certificate``."""
        if self.accepted:
            return "trivial" if self.is_trivial else "proven"
        return "rejected" if self.is_certificate else "no certificate"

    @property
    def answer(self) -> str:
        """The verdict, and what is proven or why nothing is."""
        match self.verdict:
            case "proven":
                return f"proven: {self.statement}"
            case "trivial":
                return (
                    f"true, but proves nothing: {self.statement}; 0 is a lower bound on every sum of "
                    "squares. Register without --abs-gap and --tol, or with more time, for a larger "
                    "lower bound"
                )
            case "rejected":
                return (
                    f"rejected: {self.reason}; check the clouds, or make a new certificate with "
                    "`dcreg register --certificate`"
                )
            case _:
                return self.reason

    @property
    def poses(self) -> dict[str, np.ndarray]:
        """The stated pose, if it attains the upper bound."""
        T = self.T_target_source
        return {} if T is None else {"pose of the certificate": T}

    def entries(self) -> Iterator[tuple[str, str]]:
        """Yield names and values of the summary."""
        yield "certificate", self.answer
        if self.checks:
            yield "passed", "\n".join(self.checks)
        yield "time", f"{self.time_s:.1f} s"

    def __str__(self) -> str:
        return "\n".join([*(f"ok: {passed}" for passed in self.checks), self.answer])

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON: the verdict and all attributes."""
        return plain({"verdict": self.verdict, **asdict(self)})


def pose_of(c: Certificate, *, is_swapped: bool) -> np.ndarray | None:
    """Return the pose that `theta` states, in the coordinates of the clouds; None in norm space.

    Parameters
    ----------
    c : Certificate
    is_swapped : bool
        Whether the target is the smaller cloud: in 3D, theta then moves the target.
    """
    if c.model == "translation3d":
        return None
    d = len(c.source_centre)
    T: np.ndarray = np.eye(d + 1)
    T[:d, d] = c.theta[-d:]
    if c.model == "similarity2d":
        a, b = c.theta[:2]
        T[:d, :d] = [[a, -b], [b, a]]
    else:
        T[:d, :d] = matrices(c.theta[None, :4])[0]
        T = np.linalg.inv(T) if is_swapped else T
    T[:d, d] = c.unit * T[:d, d] + c.target_centre - T[:d, :d] @ c.source_centre
    return T
