"""A wrong config is refused before anything runs, with file, key and remedy."""

from __future__ import annotations

import copy
from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml

from baselines import registry
from baselines.contract import Limits
from workflows import config
from workflows.config import ConfigError, LimitSettings
from workflows.stages.plan import expand

GOOD = {
    "name": "small",
    "datasets": [{"dataset": "embedded", "shapes": ["fish"], "tests": {"noise": [0.0, 0.01]}}],
    "methods": [{"name": "dcreg", "baseline": "dcreg"}, {"name": "icp", "baseline": "icp"}],
}


@pytest.fixture
def write(tmp_path):
    def write(content) -> str:
        path = tmp_path / "small.yaml"
        path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
        return str(path)

    return write


@pytest.fixture
def load_quick_part(write, monkeypatch):
    """Load the quick part of a config in the folder of named configs."""

    def load(content) -> config.Experiment:
        monkeypatch.setattr(config, "CONFIGS", Path(write(content)).parent)
        return config.load("small-quick")

    return load


CONFIGS = {path.stem: path for path in sorted(config.CONFIGS.glob("*.yaml"))}
WITH_QUICK = [
    n for n, path in CONFIGS.items() if "quick" in yaml.safe_load(path.read_text("utf-8"))
]
load = cache(config.load)  # seconds, for the large ones


@pytest.mark.parametrize("name", CONFIGS)
def test_the_configs_of_the_checkout_are_valid(name):
    assert load(name).name == name
    assert config.origin(name) == name


# CPU seconds per 1,000 assignments of each search at 40 points, in 2D and 3D: upper limits of the mean.
SECONDS_PER_1000 = {
    "dcreg": (0.15, 1.5), "dcreg_paper": (0.06, 0.5), "rpm_htb": (0.05, 0.1), "rpm_bp": (0.1, 0.0),
    "hbsp": (0.25, 0.35), "rpm_cav": (0.1, 0.0), "rpm_pa": (0.1, 0.0),
}  # fmt: skip
# The same for the mean run of other methods; for those left out the time limit is assumed.
SECONDS = dict.fromkeys(
    ("gnc_tls", "sc2_pcr", "sc2_pcr_pp", "ransac", "fpfh_ransac", "fpfh_fgr", "kiss_icp",
     "icp_open3d", "small_gicp", "clipper", "teaser"), 0.03,
)  # fmt: skip
SECONDS |= {
    "turboreg": 0.06,
    "icp": 0.06,
    "cpd": 0.06,
    "kiss_matcher": 0.1,
    "mac": 0.15,
    "gore": 0.3,
}
SECONDS |= dict.fromkeys(("hunter", "dcp", "dgr"), 0.0)  # from a checkout of the user
SECONDS |= {
    name: SECONDS.get(name, 0.03) for name in registry.names() if registry.read_card(name).requires
}
# Times at 100 points, relative to 40 points, of searches and of other methods.
AT_100_POINTS = (10.0, 5.0)


@pytest.mark.parametrize("name", WITH_QUICK)
def test_quick_parts_have_every_method_and_test_and_end_within_15_minutes(name):
    """On two idle cores; every run of a search takes all its assignments."""
    whole, quick = load(name), load(f"{name}-quick")
    assert quick.name == config.origin(quick.name) == f"{name}-quick"
    assert {m.baseline for m in quick.methods} == {m.baseline for m in whole.methods}
    if quick.datasets[0].dataset == "threedmatch":  # it has separate lists: test_threedmatch.py
        return
    names = [{method.name for method in each.methods} for each in (whole, quick)]
    # where a setting is varied, fewer of its values
    assert names[1] < names[0] if name == "sensitivity" else names[1] == names[0]
    tests = [{t for entry in each.datasets for t in entry.tests} for each in (whole, quick)]
    assert tests[0] == tests[1]
    plan = expand(quick)

    def seconds_of(run):
        limits, method = quick.limits_of(run.method), run.method
        is_large = run.instance.n_points != 40
        if limits.assignments is not None:
            in_3d = run.instance.model == "rigid3d"
            each = SECONDS_PER_1000[method.baseline][in_3d]
            if in_3d and method.options.get("mode") == "paper":
                each = 0.1
            return each * limits.assignments / 1000 * AT_100_POINTS[0] ** is_large
        if method.options.get("starts") == "multi":
            return limits.time_s
        each = SECONDS.get(method.baseline, np.inf) * AT_100_POINTS[1] ** is_large
        return min(limits.time_s, each)

    seconds = sum(seconds_of(run) for run in plan.runs())
    start_s = 3.0  # of a job, on one core
    assert seconds + start_s * len(list(plan.jobs())) < 2 * 14 * 60


@pytest.mark.parametrize("name", WITH_QUICK)
def test_quick_parts_have_one_limit_for_all_searches_and_one_for_all_other_methods(name):
    whole, quick = load(name), load(f"{name}-quick")
    assert {whole.limits_of(m).time_s for m in whole.methods} == {100.0}
    assert {whole.limits_of(m).assignments for m in whole.methods} == {None}
    searches = [
        m
        for m in quick.methods
        if registry.read_card(m.baseline).solves_assignments and "front_end" not in m.options
    ]
    others = [m for m in quick.methods if m not in searches]
    assert len({(quick.limits_of(m).assignments, quick.limits_of(m).time_s) for m in searches}) == 1
    assert quick.limits_of(searches[0]).assignments == quick.limits.assignments
    limits = {(quick.limits_of(m).assignments, quick.limits_of(m).time_s) for m in others}
    assert limits == {(None, quick.limits.time_s)}
    assert {quick.limits_of(m).nodes for m in quick.methods} == {None}


@pytest.mark.parametrize(
    "name", ["paper2d-40", "paper3d-40", "paper2d-40-quick", "paper3d-40-quick"]
)
def test_a_tier_is_the_experiment_with_fewer_points_in_its_own_folder(name):
    tier, whole = load(name), load(name.replace("-40", ""))
    assert tier.name == config.origin(name) == name
    assert ", 40 points" in tier.title
    assert {entry.n_points for entry in tier.datasets} == {40}
    assert (tier.methods, tier.limits) == (whole.methods, whole.limits)
    assert [entry.tests for entry in tier.datasets] == [entry.tests for entry in whole.datasets]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("paper2d_cr-40", "chui_rangarajan has a fixed number of points in def, noise"),
        ("paper2d_images-40-quick", "lian_images has a fixed number of points in marked; run"),
        (
            "threedmatch-40",
            "threedmatch has a fixed number of points in 3DMatch; run the experiment w",
        ),
        ("paper2d-2", r"datasets[0].n_points: 2; input should be greater"),
        ("paper4d-40", "no experiment 'paper4d-40'"),
        ("paper2d-quick-40", "no experiment 'paper2d-quick-40'"),
    ],
)
def test_a_tier_that_is_not_possible_is_refused(name, message):
    with pytest.raises(ConfigError) as error:
        config.load(name)
    assert message in str(error.value)


@pytest.mark.parametrize("name", ["paper2d", "paper2d_cr", "paper3d"])
def test_quick_parts_have_the_instances_that_a_verdict_needs(name):
    quick = expand(load(f"{name}-quick"))
    instances = [instance for chunk in quick.chunks for instance in chunk.instances]
    counts = Counter(instance.test for instance in instances)
    assert min(counts.values()) >= 20


@pytest.mark.parametrize("name", ["paper2d", "paper2d_cr", "paper2d_images", "paper3d"])
def test_rivals_that_receive_a_number_of_pairs_also_run_with_half_of_it(name):
    methods = load(name).methods
    counted = {
        m.baseline
        for m in methods
        if registry.read_card(m.baseline).uses_n_inliers
        and "n_inliers_ratio" not in registry.idle_options(m.baseline, m.options)
    }
    assert {m.baseline for m in methods if m.n_inliers_ratio == 0.5} == counted


def test_quick_part_overrides_limits_key_by_key_and_all_else_as_a_whole(write, load_quick_part):
    quick = {"limits": {"time_s": 1}, "methods": [{"name": "icp", "baseline": "icp"}]}
    content = {**GOOD, "title": "Small", "limits": {"memory_mb": 900}, "quick": quick}
    assert config.load(write(content)).limits.time_s == 10.0
    small = load_quick_part(content)
    assert (small.limits.time_s, small.limits.memory_mb) == (1, 900)
    assert [method.name for method in small.methods] == ["icp"]
    assert small.datasets == config.load("small").datasets
    assert (small.name, small.title) == ("small-quick", "Small, quick part")


def test_a_limit_on_assignments_replaces_the_time_limit_of_the_methods_that_stop_at_it(write):
    limits = {"time_s": 1, "assignments": 300, "safety_s": 9}
    settings = config.load(write({**GOOD, "limits": limits}))
    found = {m.name: settings.limits_of(m).of_run() for m in settings.methods}
    assert found == {
        "dcreg": Limits(9.0, memory_mb=2048, assignments=300),
        "icp": Limits(1.0, memory_mb=2048),
    }
    del limits["safety_s"]
    settings = config.load(write({**GOOD, "limits": limits}))
    assert settings.limits_of(settings.method("dcreg")).of_run().time_s == 1.0


@pytest.mark.parametrize(
    ("limits", "own", "message"),
    [
        (
            {"safety_s": 9},
            {},
            r"limits\.safety_s: has no effect without a limit on assignments; rem",
        ),
        ({}, {"dcreg": {"safety_s": 9}}, r"methods\[0\]\.limits\.safety_s: has no effect without"),
        (
            {"assignments": 300, "safety_s": 9},
            {"dcreg": {"time_s": 3}},
            r"methods\[0\]\.limits\.time_s: safety_s = 9 replaces it; give safety_s instead",
        ),
        (
            {},
            {"icp": {"assignments": 7}},
            r"methods\[1\]\.limits\.assignments: has no effect, as the",
        ),
        (
            {"assignments": 7},
            {"icp": {"safety_s": 7}},
            r"methods\[1\]\.limits\.safety_s: has no eff",
        ),
    ],
)
def test_a_limit_that_would_be_ignored_is_refused(write, limits, own, message):
    listed = [{**method, "limits": own.get(method["name"], {})} for method in GOOD["methods"]]
    with pytest.raises(ConfigError, match=message):
        config.load(write({**GOOD, "limits": limits, "methods": listed}))


def test_a_limit_that_the_harness_has_set_is_accepted_again(write):
    limits = {"time_s": 1, "assignments": 300, "safety_s": 9}
    once = config.load(write({**GOOD, "limits": limits}))
    again = config.load(write(once.model_dump(mode="json")))
    assert again.methods == once.methods


@pytest.mark.parametrize("front_end", ["oracle", "shared-mutual"])
def test_fewer_points_with_pairs_of_all_points_are_refused(write, front_end):
    listed = [{"name": "few", "baseline": "ransac", "n_points": 20}]
    content = {**GOOD, "methods": listed, "vary": {"front_end": [front_end]}}
    with pytest.raises(ConfigError, match=f"few-{front_end}: n_points: front_end {front_end} has"):
        config.load(write(content))


def test_limits_of_a_run_are_those_of_its_settings():
    assert LimitSettings(time_s=3, memory_mb=500, threads=2, assignments=9).of_run() == Limits(
        3, None, 500, 2, 9
    )


@pytest.mark.parametrize(
    ("quick", "message"),
    [
        ({"limits": 5}, r"small\.yaml: limits: 5; input should be a valid dict"),
        ({"limits": None}, r"small\.yaml: limits: None; input should be a valid dict"),
    ],
)
def test_wrong_limits_in_the_quick_part_are_refused(load_quick_part, quick, message):
    with pytest.raises(ConfigError, match=message):
        load_quick_part({**GOOD, "quick": quick})


@pytest.mark.parametrize(
    ("quick", "message"),
    [
        (None, r"small\.yaml: has no quick part"),
        (5, r"small\.yaml: has no quick part"),
        ({"limit": {}}, r"(?s)small\.yaml: limit: unknown key.* quick part; correct it, or remove"),
        ({"limits_of": {}}, r"(?s)limits_of: unknown key.* quick part; correct it, or remove"),
        ({"vary": {"n_inliers_ratio": [True]}}, r"(?s)inliers_ratio\[0\] is true.*in the quick part"),
    ],
)  # fmt: skip
def test_the_quick_part_is_checked_with_the_whole(write, quick, message):
    with pytest.raises(ConfigError, match=message):
        config.load(write({**GOOD, "quick": quick}))


def test_a_missing_quick_part_is_reported():
    with pytest.raises(ConfigError, match=r"demo\.yaml: has no quick part; add the key quick"):
        config.load("demo-quick")


def test_shared_lists_of_methods_are_read_next_to_the_config(write):
    path = write({**GOOD, "methods": ["local", {"name": "dcreg", "baseline": "dcreg"}]})
    with pytest.raises(ConfigError, match=r"small\.yaml: methods: no list 'local' in .*methods"):
        config.load(path)
    folder = Path(path).parent / "methods"
    folder.mkdir()
    (folder / "local.yaml").write_text(
        "- {name: icp, baseline: icp}\n- {name: cpd, baseline: cpd}\n"
    )
    assert [m.name for m in config.load(path).methods] == ["icp", "cpd", "dcreg"]
    (folder / "local.yaml").write_text("name: icp\n")
    with pytest.raises(ConfigError, match=r"local\.yaml: must be a list of methods"):
        config.load(path)


def test_lists_of_this_project_are_available_to_a_config_anywhere(write):
    assert len(config.load(write({**GOOD, "methods": ["points_2d"]})).methods) > 3


def test_a_share_of_pairs_for_a_method_that_counts_none_is_refused(write):
    listed = [{"name": "half", "baseline": "ransac", "n_inliers_ratio": 0.5}]
    message = r"methods\[0\]\.n_inliers_ratio: 0\.5 has no effect, as ransac"
    with pytest.raises(ConfigError, match=message):
        config.load(write({**GOOD, "methods": listed}))


def test_an_option_that_does_nothing_is_neither_taken_nor_varied(write):
    listed = [
        {"name": "tuned", "baseline": "gnc_tls", "options": {"threshold": "paper"}},
        {"name": "given", "baseline": "gnc_tls"},
        {"name": "raw", "baseline": "dcreg"},
    ]
    vary = {"noise_factor": [0.5, 2], "max_pairs": [50]}
    varied = config.load(write({**GOOD, "methods": listed[:2], "vary": vary})).methods
    assert [m.name for m in varied if m.name.startswith("tuned")] == ["tuned-max_pairs50"]
    only = {**GOOD, "methods": [listed[0], listed[2]], "vary": {"noise_factor": [2]}}
    with pytest.raises(ConfigError, match=r"vary\.noise_factor: no method has it"):
        config.load(write(only))
    listed[0]["options"]["noise_factor"] = 2.0
    message = (
        r"small\.yaml: methods\[0\]\.options: gnc_tls: .* no effect with threshold: paper; leave"
    )
    with pytest.raises(ConfigError, match=message):
        config.load(write({**GOOD, "methods": listed}))


def test_a_number_of_pairs_that_only_chooses_among_poses_is_not_varied_for_one_pose(write):
    listed = [
        {"name": starts, "baseline": "kiss_icp", "options": {"starts": starts}}
        for starts in ("identity", "multi")
    ]
    content = {**GOOD, "methods": [*listed, {"name": "cpd", "baseline": "cpd"}]}
    content["datasets"] = [{**GOOD["datasets"][0], "shapes": ["pony"]}]
    varied = config.load(write({**content, "vary": {"n_inliers_ratio": [0.5]}})).methods
    names = ["identity", "multi-n_inliers_ratio0.5", "cpd-n_inliers_ratio0.5"]
    assert [method.name for method in varied] == names


def test_settings_are_varied_one_at_a_time_for_the_methods_that_take_them(write):
    tuned = {"front_end": "oracle", "noise_factor": 3.0}
    listed = [
        {"name": "icp", "baseline": "icp"},
        {"name": "mac", "baseline": "mac"},
        {"name": "given", "baseline": "icp", "n_inliers_ratio": 1.0},
        {"name": "tuned", "baseline": "mac", "options": tuned},
    ]
    vary = {"front_end": ["oracle"], "n_inliers_ratio": [0.5, 1], "noise_factor": [2]}
    varied = config.load(write({**GOOD, "methods": listed, "vary": vary})).methods
    assert [(m.name, m.n_inliers_ratio, m.options) for m in varied] == [
        ("icp-n_inliers_ratio0.5", 0.5, {}),
        ("icp-n_inliers_ratio1", 1.0, {}),
        ("mac-oracle", 1.0, {"front_end": "oracle"}),
        ("mac-noise_factor2", 1.0, {"noise_factor": 2.0}),
        ("given", 1.0, {}),
        ("tuned", 1.0, tuned),
    ]
    assert [m.label for m in varied[2:4]] == ["MAC (oracle)", "MAC (noise_factor × 2)"]


@pytest.mark.parametrize(
    ("vary", "expected"),
    [
        ({"noise": [1]}, "vary.noise: no method has it; name n_inliers_ratio or an option"),
        (
            {"n_inliers_ratio": [3]},
            "vary.n_inliers_ratio: 3; input should be less than or equal to 2",
        ),
        (
            {"front_end": ["fpfh"]},
            "vary.front_end, method mac.options: mac: option front_end = 'fpf",
        ),
        ({"noise_factor": []}, "vary.noise_factor: []; list should have at least 1 item"),
    ],
)
def test_impossible_variations_are_refused(write, vary, expected):
    listed = [{"name": "icp", "baseline": "icp"}, {"name": "mac", "baseline": "mac"}]
    with pytest.raises(ConfigError) as error:
        config.load(write({**GOOD, "methods": listed, "vary": vary}))
    assert expected in str(error.value)


def test_a_small_config_gets_the_documented_defaults(write):
    settings = config.load(write(GOOD))
    assert settings.datasets[0].trials == 1
    assert settings.limits.memory_mb == 2048
    assert settings.method("dcreg").n_inliers_ratio == 1.0


@pytest.mark.parametrize(
    ("place", "value", "expected"),
    [
        ("name", "a/b", "name: 'a/b'; string should match pattern"),
        ("chunk_size", True, "chunk_size is true; give a number"),
        ("vary.noise_factor", [True], "vary.noise_factor[0] is true; give a number"),
        ("limits.time_s", True, "time_s is true; give a number or text"),
        ("limits.time_s", float("inf"), "limits.time_s: inf; input should be less than or equal"),
        ("limits.memory_mb", 1, "limits.memory_mb: 1; input should be greater than or equal"),
        ("limits.nodes", 10**40, "00000; input should be less than or equal to 1000"),
        ("limits.threads", 10**6, "limits.threads: 1000000; input should be less"),
        ("datasets.0.trial", 2, "datasets[0].trial: unknown key; did you mean 'trials'?"),
        ("datasets.0.tests.noise", [0.0, True], "datasets[0]: tests.noise[1] is true; gi"),
        ("datasets.0.tests.noise", [1, 1], "noise: give one or more different levels"),
        ("datasets.0.tests.noise", [1e300], "noise: level 1e+300; give one from 0 to 10"),
        ("datasets.0.shapes", "fish", "shapes: is 'fish'; list at least one, or leave it out"),
        ("datasets.0.shapes", ["fish", "fish"], "a shape is listed twice; list each once"),
        ("datasets.0.n_points", 10**9, "1000000000; input should be less than or equal to 100000"),
        ("methods.0.models", [], "models: is []; list at least one, or leave it out for all"),
        ("methods.0.models", ["rigid3d"], "methods[0].models: no dataset has rigid3d, only simi"),
        ("methods.0.n_inliers_ratio", float("nan"), "n_inliers_ratio: nan; input should be less"),
        ("methods.0.limits", {"time_s": True}, "methods[0]: limits.time_s is true; give"),
        ("methods.0.options", {"mode": "fast"}, "methods[0].options: dcreg: option mode = 'fast'"),
        ("methods.0.options", {"rel_gap": float("nan")}, "nan is not finite; give a number"),
    ],
)
def test_errors_name_the_file_the_key_and_a_remedy(write, place, value, expected):
    """More of them are in `tests.bad_input.configs`."""
    content = copy.deepcopy(GOOD)
    part = content
    *steps, key = place.split(".")
    for step in steps:
        part = part[int(step)] if step.isdigit() else part.setdefault(step, {})
    part[key] = value
    with pytest.raises(ConfigError) as error:
        config.load(write(content))
    assert "small.yaml: " in str(error.value)
    assert expected in str(error.value)


def test_all_errors_are_listed_at_once(write):
    content = copy.deepcopy(GOOD)
    content["methods"] += [{"name": "a", "baseline": "nope"}, {"name": "b", "baseline": "nope"}]
    with pytest.raises(ConfigError) as error:
        config.load(write(content))
    assert str(error.value).count("no method 'nope'") == 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tests": {"def": [9]}, "trials": 1000}, r"(?s)no level 9.*trials, not 1000"),
        ({"tests": {"def": [1]}, "n_points": 50}, r"datasets\[0\]\.n_points: .* remove it"),
    ],
)
def test_a_recorded_dataset_has_only_its_levels_trials_and_points(write, changes, message):
    with pytest.raises(ConfigError, match=message):
        config.load(write({**GOOD, "datasets": [{"dataset": "chui_rangarajan", **changes}]}))


def test_the_same_config_elsewhere_may_not_write_into_the_results_of_the_first(write):
    text = (config.CONFIGS / "demo.yaml").read_text(encoding="utf-8")
    with pytest.raises(ConfigError, match=r"small\.yaml: name: 'demo' is the name of"):
        config.load(write(text))
    assert config.load(write(text.replace("name: demo\n", "name: mine\n"))).name == "mine"


# Each list repeats the one before nine times: 9^9 entries.
LAUGHS = "k0: &k0 [x]\n" + "".join(
    f"k{i}: &k{i} [{', '.join([f'*k{i - 1}'] * 9)}]\n" for i in range(1, 10)
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("5: x", "; keys should be strings"),
        ("[1, 2]: 3", "not valid YAML"),
        ("name: 2020-99-99", "not valid YAML"),
        (f"seed: {'9' * 5000}", "not valid YAML"),
        ("[" * 3000, "not valid YAML"),
        ("name: &a {k: *a}", "recursive"),
        (LAUGHS, "aliases stand for more than"),
        ("name: !!python/object:os.system x", "not valid YAML"),
    ],
)
def test_text_that_is_no_config_is_refused(write, text, expected):
    with pytest.raises(ConfigError, match=expected):
        config.load(write(text))


def test_bytes_that_are_no_text_are_refused(tmp_path):
    path = tmp_path / "small.yaml"
    path.write_bytes(b"\xff\xfe\x00name: x")
    with pytest.raises(ConfigError, match=r"small\.yaml: not valid YAML"):
        config.load(str(path))


def test_an_unknown_experiment_is_named_with_a_suggestion():
    with pytest.raises(ConfigError, match="no experiment 'deno'; did you mean 'demo'"):
        config.load("deno")


def test_a_selection_is_parsed_by_axis():
    chosen = config.parse_selection(["tests=noise, def", "levels=0.1", "methods="])
    assert (chosen.tests, chosen.levels, chosen.methods) == (["noise", "def"], [0.1], [])
    with pytest.raises(ConfigError, match=r"selection levels\[0\]: 'high'"):
        config.parse_selection(["levels=high"])
