"""The history page marks the steps that the comparison finds, and nothing else."""

import re

import numpy as np
import pytest
from record_fixture import N_RUNS, table, write_record

from reports.history import page, steps


@pytest.fixture
def history(rng, tmp_path):
    """Four versions: the second repeats the first, the third divides more, the fourth is elsewhere."""
    first = table(rng)
    third = first.assign(n_nodes=first["n_nodes"] + 5, time_solve_s=first["time_solve_s"] * 3)
    versions = {
        "v1": first, "v2": first.assign(time_solve_s=first["time_solve_s"] * 1.2), "v3": third,
        "v4": third.assign(machine_id="other", time_solve_s=first["time_solve_s"]),
    }  # fmt: skip
    for day, (version, runs) in enumerate(versions.items(), start=1):
        write_record(tmp_path / "records" / version / "e", runs, f"2026-01-0{day}")
    return tmp_path / "records"


def lines(history) -> dict[str, steps.Line]:
    (found,) = steps.load(history)
    assert list(found.records) == ["v1", "v2", "v3", "v4"]
    return {line.metric.title: line for line in found.lines["dcreg"]}


def test_steps_are_at_their_version(history):
    found = {title: [p.version for p in line.steps] for title, line in lines(history).items()}
    assert found.pop("boxes") == ["v3"]
    assert found.pop("time") == ["v3"]  # the fourth version ran on another machine
    assert not any(found.values())


def test_steps_are_the_verdicts_of_a_comparison(rng, tmp_path):
    """A lost pose is a step; two tests of six runs each are none, as one of them alone would be."""
    first = table(rng)
    second = first.copy()
    second.loc[0, ["status", "rmse", "objective"]] = ["failed", np.nan, np.nan]
    third = second.assign(machine_id="other")  # on one machine, a lost success is a step by itself
    third.loc[1:6, "success"] = False
    third.loc[1:6, "objective"] *= 1.1
    for day, runs in enumerate([first, second, third], start=1):
        write_record(tmp_path / f"v{day}" / "e", runs, f"2026-01-0{day}")
    (found,) = steps.load(tmp_path)
    marked = {line.metric.title: [p.version for p in line.steps] for line in found.lines["dcreg"]}
    assert marked["without pose"] == ["v2"]
    assert marked["success"] == marked["objective"] == []


def test_a_line_of_times_ends_where_the_machine_changes(history):
    found = lines(history)
    versions = ["v1", "v2", "v3", "v4"]
    assert [len(part.split()) for part in page.draw(found["time"], versions).parts] == [3, 1]
    assert [len(part.split()) for part in page.draw(found["boxes"], versions).parts] == [4]


def test_the_page_is_one_file_and_names_version_and_verdict(history, tmp_path):
    planted = tmp_path / "planted.csv"
    planted.write_text(
        "change,trial,alarm,alarm_time,alarm_work,similarity2d_ratio,similarity2d_noise\n"
        "slow-down,0,True,True,False,1.2,0.01\nslow-down,1,False,False,False,1.1,0.01\n"
    )
    text = page.build(tmp_path, history, planted).read_text()
    assert not re.search(r"<(script|link|img)|https?://", text)
    assert text.count("<polyline") == len(lines(history)) + 1
    rows = re.findall(
        r'<tr><th scope="row">v3</th><td data-title="experiment">e</td>.*?</tr>', text
    )
    assert len(rows) == 2
    assert f"{N_RUNS - 2} of {N_RUNS - 2} runs differ" in " ".join(rows)
    assert f": {N_RUNS - 2} with more work, 0 with less" in " ".join(rows)
    assert "Slow-down: 1 alarm in 2 comparisons." in text


def test_a_history_without_records_says_how_to_begin(tmp_path):
    text = page.build(tmp_path, tmp_path / "none", tmp_path / "none.csv").read_text()
    assert "make record" in text
