"""Configs of the benchmark."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from tests.bad_input.case import Case

GOOD = """name: bad
title: Bad
limits: {time_s: 1, memory_mb: 2048}
datasets:
  - dataset: embedded
    shapes: [fish]
    n_points: 30
    trials: 1
    tests: {noise: [0.01], occlusion_outliers: [0.1]}
methods:
  - {name: icp, baseline: icp}
"""
CHANGES = {
    "no YAML": (GOOD, "a: [", "not valid YAML", "bad.yaml"),
    "a list": (GOOD, "- 1\n- 2\n", "must be a mapping", "keys to values"),
    "nothing": (GOOD, "", "must be a mapping", "keys to values"),
    "key twice": ("title: Bad", "title: A\ntitle: B", "'title' is given twice", "bad.yaml"),
    "unknown key": ("title: Bad", "titel: Bad", "titel: unknown key", "did you mean 'title'"),
    "no datasets": ("datasets:", "data:", "datasets: missing", "add it"),
    "no methods": ("methods:\n  - {name: icp, baseline: icp}", "", "methods: missing", "add it"),
    "empty methods": ("\n  - {name: icp, baseline: icp}", " []", "methods", "at least 1 item"),
    "unknown dataset": ("dataset: embedded", "dataset: embeded", "'embeded'", "'embedded'"),
    "unknown shape": ("[fish]", "[fisch]", "no shape 'fisch'", "did you mean 'fish'"),
    "no shapes": ("[fish]", "[]", "datasets[0].shapes: is []", "list at least one"),
    "unknown test": ("noise:", "noize:", "no such test", "did you mean 'noise'"),
    "no tests": ("{noise: [0.01], occlusion_outliers: [0.1]}", "{}", "tests", "at least 1"),
    "no levels": ("[0.01]", "[]", "datasets[0].tests", "give one or more"),
    "negative level": ("[0.01]", "[-1]", "tests.noise", "-1"),
    "level nan": ("[0.01]", "[.nan]", "level nan is not finite", "give a number"),
    "level of words": ("[0.01]", "[low]", "tests.noise", "'low'"),
    "occlusion of twice": ("[0.1]", "[2.0]", "tests.occlusion_outliers", "2.0"),
    "no trials": ("trials: 1", "trials: 0", "trials", "greater than"),
    "trials without end": ("trials: 1", "trials: 1000000000", "2,000,000,000 runs", "lower trials"),
    "trials of words": ("trials: 1", "trials: few", "trials", "valid integer"),
    "no points": ("n_points: 30", "n_points: 0", "n_points", "greater than"),
    "negative points": ("n_points: 30", "n_points: -3", "n_points", "greater than"),
    "no time": ("time_s: 1", "time_s: 0", "limits.time_s", "greater than"),
    "negative time": ("time_s: 1", "time_s: -1", "limits.time_s", "greater than"),
    "time nan": ("time_s: 1", "time_s: .nan", "limits.time_s", "nan"),
    "time of words": ("time_s: 1", "time_s: 1h", "limits.time_s", "valid number"),
    "no memory": ("memory_mb: 2048", "memory_mb: 0", "limits.memory_mb", "greater than"),
    "unknown limit": ("time_s: 1", "seconds: 1", "limits.seconds: unknown key", "known: "),
    "unknown method": ("baseline: icp", "baseline: icpp", "no method 'icpp'", "did you mean 'icp'"),
    "name as long as a text": ("name: bad", "name: " + 300 * "a", "name", "at most 100"),
    "list for a word": (
        "baseline: icp", "baseline: dcreg, options: {mode: [full]}",
        "option mode = ['full'] is a list", "give one value",
    ),
    "name of a method": ("name: icp", "name: 'a b'", "methods[0].name", "'a b'"),
    "unknown option": ("baseline: icp", "baseline: icp, options: {x: 1}", "options.x", "known: "),
    "unknown limit of a method": ("baseline: icp", "baseline: icp, limits: {x: 1}", "methods[0]",
                                  "unknown key"),
    "unknown key of a method": ("baseline: icp", "baseline: icp, x: 1", "methods[0].x", "unknown key"),
    "unknown model": ("baseline: icp", "baseline: icp, models: [affine]", "models", "'affine'"),
    "pairs beyond": ("baseline: icp", "baseline: icp, n_inliers_ratio: 0", "n_inliers_ratio", "greater"),
    "unknown bound": ("name: icp, baseline: icp", "name: d, baseline: dcreg, options: {bound: foo}",
                      "bound: 'foo' is unknown", "known: dc"),
    "method twice": ("  - {name: icp, baseline: icp}",
                     "  - {name: icp, baseline: icp}\n  - {name: icp, baseline: icp}",
                     "name 'icp' is used 2 times", "give different names"),
}  # fmt: skip


def _load(experiment: str) -> None:
    from workflows import config

    config.load(experiment)


def _select(text: str) -> None:
    from workflows import config

    config.parse_selection([text])


def _cases() -> Iterator[Case]:
    for name, (old, new, *words) in CHANGES.items():
        assert old in GOOD, name
        files: dict[str, bytes | None] = {"bad.yaml": GOOD.replace(old, new, 1).encode()}
        yield Case("configs", name, partial(_load, "bad.yaml"), words, files)
    for name, experiment, words in (
        ("unknown name", "dema", ["no experiment 'dema'", "known: "]),
        ("missing file", "absent.yaml", ["absent.yaml: no such config file", "correct the path"]),
    ):
        yield Case("configs", name, partial(_load, experiment), words)
    for text, words in (
        ("test=noise", ["selection 'test=noise'", "did you mean 'tests'"]),
        ("noise", ["selection 'noise'", "known: "]),
    ):
        yield Case("configs", f"selection {text}", partial(_select, text), words)


CASES = list(_cases())
