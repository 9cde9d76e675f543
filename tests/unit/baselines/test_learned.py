"""The whole path of the learned methods, with stand-in checkouts: child process, files, errors.

The stand-ins fit the pose of paired points (row i of the source is row i of the target), so a wrong
normalisation, order or direction on the way shows as a wrong pose.
"""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from baselines import registry
from baselines.contract import Instance, Limits, Solution
from dcreg.status import Status

METHODS = ["dcp", "dgr", "hunter"]
LIMITS = Limits(time_s=20.0)

FIT = """
    import numpy as np

    def fit(source, target):
        mean_x, mean_y = source.mean(axis=0), target.mean(axis=0)
        u, _, vt = np.linalg.svd((target - mean_y).T @ (source - mean_x))
        rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        return rotation, mean_y - rotation @ mean_x

    def pose(source, target):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = fit(source, target)
        return T
"""

# As much of torch as the runners and the stand-ins use.
TORCH = """
    import contextlib
    import numpy as np

    float32 = np.float32

    class Tensor:
        def __init__(self, values, device):
            self.values, self.at = values, device
        def __getitem__(self, index):
            return Tensor(self.values[index], self.at)
        def cpu(self):
            return self
        def numpy(self):
            return self.values

    def tensor(values, dtype, device):
        return Tensor(np.asarray(values, dtype), device)

    def device(name):
        if name == "cuda":
            raise RuntimeError("Torch not compiled with CUDA enabled")
        return name

    def load(path, map_location):
        return {"loaded": open(path).read(), "at": map_location}

    @contextlib.contextmanager
    def no_grad():
        yield
"""

DCP_MODEL = """
    from types import SimpleNamespace
    import torch
    from fit import fit

    class DCP:
        def __init__(self, args):
            print("the checkout prints to stdout")
            self.pointer = args.pointer
        def load_state_dict(self, state, strict):
            assert state == {"loaded": "weights", "at": "cpu"}
            lacking = [] if self.pointer == "transformer" else ["pointer.model.norm.a_2"]
            return SimpleNamespace(missing_keys=["head.reflect", *lacking])
        def to(self, device):
            return self
        def eval(self):
            return self
        def __call__(self, source, target):
            device = torch.device("cuda")  # as in the authors' code, also without a GPU
            x, y = (cloud.values[0].T.astype(float) for cloud in (source, target))
            assert abs(x).max() <= 1 and source.values.dtype == torch.float32
            rotation, translation = fit(x, y)
            return tuple(torch.Tensor(v[None], device) for v in (rotation, translation)) * 2
"""

DGR_PIPELINE = """
    import os
    import torch
    from fit import pose
    from util.names import NAME

    class DeepGlobalRegistration:
        def __init__(self, config, device):
            assert open(config.weights).read() == "weights" and device == "cpu"
            assert config.clip_weight_thresh == 0.05 and os.path.exists("core")
        def register(self, source, target):
            print(NAME)
            return pose(source, target)
"""

ENTRY = """
    import os
    import time
    import numpy as np
    from fit import pose

    mode = os.environ.get("STAND_IN", "")
    if mode == "no import":
        import no_such_module

    def register(source, target, weights, device):
        assert device == "cpu" and open(weights).read() == "weights"
        if mode == "raise":
            raise ValueError("too few matches")
        if mode == "crash":
            os._exit(3)
        if mode == "print and crash":
            os.write(2, b"Segmentation fault\\n")
            os._exit(4)
        if mode == "sleep":
            time.sleep(60)
        if mode == "shape":
            return np.eye(3)
        if mode == "nan":
            return np.full((4, 4), np.nan)
        if mode == "mirror":
            return np.diag([1.0, 1.0, -1.0, 1.0])
        if mode == "seed":
            T = np.eye(4)
            T[:3, 3] = np.random.rand(3)
            return T
        return pose(source, target)
"""


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(textwrap.dedent(text), encoding="utf-8")


@pytest.fixture
def places(tmp_path: Path) -> dict[str, str]:
    """Options that name a stand-in checkout, good for all three methods, and its weights."""
    checkout = tmp_path / "checkout"
    write(checkout / "fit.py", FIT)
    write(checkout / "torch.py", TORCH)
    write(checkout / "model.py", DCP_MODEL)
    write(checkout / "core" / "deep_global_registration.py", DGR_PIPELINE)
    write(checkout / "util" / "names.py", "NAME = 'a module of the checkout'\n")
    write(checkout / "dcreg_entry.py", ENTRY)
    weights = tmp_path / "weights.pth"
    weights.write_text("weights")
    return {"checkout": str(checkout), "weights": str(weights)}


@pytest.fixture(autouse=True)
def no_places_from_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in METHODS:
        for place in ("CHECKOUT", "WEIGHTS", "PYTHON", "DEVICE"):
            monkeypatch.delenv(f"DCREG_{name.upper()}_{place}", raising=False)
    monkeypatch.delenv("STAND_IN", raising=False)


def instance(seed: int = 0, n_points: int = 30) -> Instance:
    generator = np.random.default_rng(seed)
    source = 7.0 + 3.0 * generator.standard_normal((n_points, 3))
    pose = truth(seed)
    target = source @ pose[:3, :3].T + pose[:3, 3]
    return Instance("easy", source, target, "rigid3d", n_points, (1.0, 1.0), 0.01, seed)


def truth(seed: int = 0) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(rng=seed).as_matrix()
    pose[:3, 3] = [1.0, -20.0, 3.0]
    return pose


def ask(mode: str, places: dict, monkeypatch: pytest.MonkeyPatch, **limits: float) -> Solution:
    monkeypatch.setenv("STAND_IN", mode)
    return registry.load("hunter", **places).solve(instance(), Limits(**{"time_s": 20.0, **limits}))


@pytest.mark.parametrize("name", METHODS)
class TestEveryMethod:
    def test_without_places_it_is_unavailable_with_the_remedy(self, name: str) -> None:
        reason = registry.load(name).available()
        assert f"DCREG_{name.upper()}_CHECKOUT" in reason
        solution = registry.load(name).solve(instance(), LIMITS)
        assert solution.status is Status.UNAVAILABLE
        assert solution.message == reason

    def test_registers_with_the_stand_in(self, name: str, places: dict) -> None:
        method = registry.load(name, **places)
        assert method.available() is None
        method.warm_up(instance())
        for seed in (0, 1):  # the same child answers again
            solution = method.solve(instance(seed), LIMITS)
            assert solution.status is Status.CONVERGED, solution.message
            np.testing.assert_allclose(solution.T_target_source, truth(seed), atol=1e-4)

    def test_environment_names_the_places(
        self, name: str, places: dict, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        for place, value in places.items():
            monkeypatch.setenv(f"DCREG_{name}_{place}".upper(), value)
        assert registry.load(name).available() is None
        assert registry.load(name).solve(instance(), LIMITS).status is Status.CONVERGED

    @pytest.mark.parametrize(
        ("place", "value", "words"),
        [
            ("weights", "no_such_file.pth", "weights no_such_file.pth is not a file"),
            ("checkout", "no_such_folder", "checkout no_such_folder is not a folder"),
            ("python", "no_such_python", "python no_such_python is not an executable"),
        ],
    )
    def test_wrong_places_are_named(
        self, name: str, places: dict, place: str, value: str, words: str
    ) -> None:
        method = registry.load(name, **{**places, place: value})
        assert method.available().startswith(words)
        assert method.available().endswith(method.card.how_to_get)


def test_a_folder_that_is_no_checkout_is_named(places: dict, tmp_path: Path) -> None:
    reason = registry.load("dcp", **{**places, "checkout": str(tmp_path)}).available()
    assert "has no model.py" in reason


def test_clouds_too_small_for_the_network_are_unsupported(places: dict) -> None:
    method = registry.load("dcp", **places)
    assert "20 points" in method.supports(instance(n_points=19))
    assert method.supports(instance(n_points=20)) is None


def test_weights_of_another_layout_are_refused(places: dict) -> None:
    solution = registry.load("dcp", pointer="identity", **places).solve(instance(), LIMITS)
    assert solution.status is Status.FAILED
    assert "weights lack pointer.model.norm.a_2 and 0 more" in solution.message


@pytest.mark.parametrize(
    ("mode", "words"),
    [
        ("no import", "ModuleNotFoundError: No module named 'no_such_module'"),
        ("raise", "ValueError: too few matches"),
        ("crash", "process ended with code 3"),
        ("print and crash", "process ended with code 4: Segmentation fault"),
        ("shape", "shape (3, 3), not (4, 4)"),
        ("nan", "not finite"),
        ("mirror", "not a rotation"),
    ],
)
def test_failures_report_their_reason(
    mode: str, words: str, places: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    solution = ask(mode, places, monkeypatch)
    assert solution.status is Status.FAILED
    assert solution.T_target_source is None
    assert words in solution.message


def test_a_slow_answer_is_a_time_limit_and_the_next_one_is_fresh(
    places: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STAND_IN", "sleep")
    method = registry.load("hunter", **places)
    solution = method.solve(instance(), Limits(time_s=1.0))
    assert solution.status is Status.TIME_LIMIT
    np.testing.assert_array_equal(solution.T_target_source, np.eye(4))
    method._drop_child()
    monkeypatch.setenv("STAND_IN", "")
    solution = method.solve(instance(), LIMITS)
    assert solution.status is Status.CONVERGED
    np.testing.assert_allclose(solution.T_target_source, truth(), atol=1e-6)


def test_a_crash_does_not_spoil_the_next_instance(
    places: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STAND_IN", "crash")
    method = registry.load("hunter", **places)
    assert method.solve(instance(), LIMITS).status is Status.FAILED
    monkeypatch.setenv("STAND_IN", "")
    assert method.solve(instance(), LIMITS).status is Status.CONVERGED


def test_random_numbers_follow_the_seed(places: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    poses = [ask("seed", places, monkeypatch).T_target_source for _ in range(2)]
    np.testing.assert_array_equal(*poses)


def test_the_child_ends_with_its_adapter(places: dict) -> None:
    method = registry.load("hunter", **places)
    method.solve(instance(), LIMITS)
    process = method._child._process
    folder = Path(method._child._folder.name)
    assert process.poll() is None
    assert folder.is_dir()
    del method
    assert process.poll() is not None
    assert not folder.exists()


def test_other_interpreters_and_entries(places: dict, tmp_path: Path) -> None:
    python = tmp_path / "python"
    write(python, f'#!/bin/sh\nexport FROM=wrapper\nexec {sys.executable} "$@"\n')
    python.chmod(0o755)
    entry = "import os\nfrom fit import pose as fitted\nassert os.environ['FROM'] == 'wrapper'\n"
    entry += "def run(source, target, weights, device):\n    return fitted(source, target)\n"
    write(Path(places["checkout"]) / "mine.py", entry)
    options = {**places, "python": str(python), "entry": "mine:run"}
    assert registry.load("hunter", **options).solve(instance(), LIMITS).status is Status.CONVERGED
