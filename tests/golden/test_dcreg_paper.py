"""DC-Reg as published, against an independent program for Algorithm 1."""

from __future__ import annotations

from pathlib import Path

import pytest

from baselines.dcreg_paper.__main__ import Case, main
from dcreg.status import Status
from workflows.studies.golden import golden_folder

FOLDER = golden_folder()
FILES = sorted(FOLDER.glob("algorithm1_*.npz")) if FOLDER else []
# Boxes with bounds that are equal up to rounding: here the order of two decides whether the last
# iteration is needed, and with it the lower bound.
TIED = "algorithm1_fish_mixed_1_0_40"

pytestmark = pytest.mark.skipif(
    not FILES, reason="needs golden/algorithm1_*.npz beside the folder that DCREG_DATA_MIRROR names"
)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_finds_the_stated_bounds(path: Path) -> None:
    case, stated = Case.read(path)
    found = case.solve()
    assert found.status is Status.OPTIMAL
    assert found.n_nodes == pytest.approx(stated["boxes"], rel=0.01)
    assert found.upper_bound == pytest.approx(stated["upper_bound"], abs=1e-6)
    tolerance = 0.01 * float(case.eps) if path.stem == TIED else 1e-6
    assert found.lower_bound == pytest.approx(stated["lower_bound"], abs=tolerance)


def test_command_prints_found_and_stated(monkeypatch, capsys) -> None:
    path = next(path for path in FILES if path.stem == "algorithm1_horse_def_03_0_40")
    monkeypatch.setattr("sys.argv", ["dcreg_paper", str(path)])
    main()
    assert "7241                  7241" in capsys.readouterr().out
