"""The adapter of py_goicp, judged by a stand-in module: wiring, units, limits and failures."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from baselines import registry
from baselines.contract import Instance, Limits
from baselines.py_goicp.adapter import trim_fraction
from dcreg.problem import apply_pose
from dcreg.status import Status

# Pairs points by index and fits them, which is enough to see whether units and axes are kept. It
# prints to standard output like the real library.
STAND_IN = """
import json, pathlib, time
import numpy as np

class POINT3D:
    def __init__(self, x, y, z): self.x, self.y, self.z = x, y, z
class ROTNODE: pass
class TRANSNODE: pass

class GoICP:
    def loadModelAndData(self, n_model, model, n_data, data):
        assert n_model == len(model) and n_data == len(data)
        self.model = np.array([[p.x, p.y, p.z] for p in model])
        self.data = np.array([[p.x, p.y, p.z] for p in data])
    def setInitNodeRot(self, node): self.rot = vars(node)
    def setInitNodeTrans(self, node): self.trans = vars(node)
    def setDTSizeAndFactor(self, size, factor): self.dt = [size, factor]
    def BuildDT(self): print("Building Distance Transform...")
    def Register(self):
        print("Registering...")
        BEHAVIOUR
        a, b = self.data - self.data.mean(0), self.model - self.model.mean(0)
        u, _, vt = np.linalg.svd(b.T @ a)
        self.R = (u * [1, 1, np.linalg.det(u @ vt)]) @ vt
        self.t = self.model.mean(0) - self.R @ self.data.mean(0)
        settings = dict(rot=self.rot, trans=self.trans, dt=self.dt, mse=self.MSEThresh,
                        trim=self.trimFraction, do_trim=self.doTrim,
                        largest=float(max(abs(self.model).max(), abs(self.data).max())))
        pathlib.Path(__file__).with_name("settings.json").write_text(json.dumps(settings))
    def optimalRotation(self): return self.R.astype(np.float32).tolist()
    def optimalTranslation(self): return self.t.astype(np.float32).tolist()
"""


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, behaviour: str = "pass") -> None:
    (folder / "py_goicp.py").write_text(STAND_IN.replace("BEHAVIOUR", behaviour))
    monkeypatch.syspath_prepend(str(folder))
    # set before it is deleted: so the stand-in that gets imported is gone when the test is over
    monkeypatch.setitem(sys.modules, "py_goicp", None)
    monkeypatch.delitem(sys.modules, "py_goicp")


def problem(n_inliers: int = 20) -> Instance:
    generator = np.random.default_rng(2)
    source = 40.0 + 30.0 * generator.uniform(-1, 1, (20, 3))
    turn = Rotation.from_rotvec([0.5, 1.0, -2.0]).as_matrix()
    target = source @ turn.T + [9.0, -70.0, 5.0]
    return Instance("p", source, target, "rigid3d", n_inliers, (1, 1), 0.1, 0)


def test_is_unavailable_with_instructions_where_it_is_missing() -> None:
    method = registry.load("py_goicp")
    reason = method.available()
    if reason is None:
        pytest.skip("py_goicp is installed here")
    assert "py-goicp" in reason
    assert "goicp of this repository" in reason


def test_pose_and_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path, monkeypatch)
    method = registry.load("py_goicp", mse_threshold=0.0005)
    assert method.available() is None
    instance = problem(n_inliers=15)
    solution = method.solve(instance, Limits(time_s=60.0))
    assert solution.status is Status.CONVERGED
    moved = apply_pose(solution.T_target_source, instance.source)
    np.testing.assert_allclose(moved, instance.target, atol=1e-3)
    rotation = solution.T_target_source[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    used = json.loads((tmp_path / "settings.json").read_text())
    assert used["mse"] == 0.0005
    assert used["dt"] == [300, 2.0]
    assert used["trans"] == {"x": -0.5, "y": -0.5, "z": -0.5, "w": 1.0}
    assert used["rot"]["a"] == pytest.approx(-np.pi)
    assert used["rot"]["w"] == pytest.approx(2 * np.pi)
    assert used["do_trim"] is True
    assert int(20 * (1 - used["trim"])) == 15
    assert used["largest"] == pytest.approx(1.0)


def test_all_points_are_kept_without_trimming(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path, monkeypatch)
    registry.load("py_goicp").solve(problem(), Limits(time_s=60.0))
    used = json.loads((tmp_path / "settings.json").read_text())
    assert used["do_trim"] is False
    assert used["trim"] == 0.0


def test_ends_at_the_time_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path, monkeypatch, "time.sleep(60)")
    instance = problem()
    solution = registry.load("py_goicp").solve(instance, Limits(time_s=1.0))
    assert solution.status is Status.TIME_LIMIT
    moved = apply_pose(solution.T_target_source, instance.source)
    np.testing.assert_allclose(moved.mean(axis=0), instance.target.mean(axis=0))


@pytest.mark.parametrize("behaviour", ["raise RuntimeError('no memory')", "import os; os._exit(9)"])
def test_a_crash_is_a_failure_with_a_reason(
    behaviour: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path, monkeypatch, behaviour)
    solution = registry.load("py_goicp").solve(problem(), Limits(time_s=60.0))
    assert solution.status is Status.FAILED
    assert solution.T_target_source is None
    assert "py_goicp ended with code" in solution.message


def test_trim_fraction_keeps_the_number_asked_for() -> None:
    for n in range(1, 200):
        for n_kept in range(1, n + 1):
            assert int(np.floor(n * (1 - trim_fraction(n_kept, n)))) == n_kept
