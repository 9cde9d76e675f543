"""Commands that read results refuse damaged files, also without Snakemake."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest
import report_fixture
from typer.testing import CliRunner

import reports.campaign.run
from reports.__main__ import app
from reports.tables import Tables, started_in
from workflows import exact, recording, replay
from workflows.blocks import Needs
from workflows.compose import ConfigError
from workflows.integrity import (
    DAMAGED,
    SUMS,
    DamagedError,
    is_damaged,
    sealed_file,
    set_aside_damaged,
)

REFUSED = r"{}: damaged, its SHA-256 .* `python -m workflows run EXPERIMENT`"
FILES = (
    "runs.parquet", "traces.parquet", "clouds.parquet", "accounting.csv", "provenance.json",
    "overlays.json", "runs.csv",
)  # fmt: skip
EXPERIMENT = "paper2d"


def seal(folder: Path) -> None:
    """Write checksums of all files."""
    for path in sorted(folder.iterdir()):
        content = path.read_bytes()
        with sealed_file(path) as part:
            part.write_bytes(content)


def change(path: Path, at: int) -> None:
    content = bytearray(path.read_bytes())
    content[at] ^= 1
    path.write_bytes(content)


def changes(path: Path, positions: Iterable[int]) -> Iterator[None]:
    """Change one byte after the other, each alone."""
    content = path.read_bytes()
    for at in positions:
        change(path, at)
        yield
        path.write_bytes(content)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Results with a checksum of every table."""
    place = tmp_path / "results" / EXPERIMENT
    seal(report_fixture.write_tables(place / "tables", EXPERIMENT, report_fixture.CASES[:1]))
    return place


@pytest.mark.parametrize("name", FILES)
def test_no_table_with_a_changed_byte_is_loaded(name, folder, rng):
    path = folder / "tables" / name
    size = path.stat().st_size
    for _ in changes(path, [0, *rng.integers(size, size=100), size - 1]):
        with pytest.raises(DamagedError, match=REFUSED.format(name)):
            Tables.load(path.parent)
    Tables.load(path.parent)


def test_tables_without_checksums_are_loaded_if_they_can_be_read(folder):
    path = folder / "tables" / "runs.parquet"
    (folder / "tables" / SUMS).unlink()
    Tables.load(path.parent)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DamagedError, match=r"runs\.parquet: cannot be read .* EXPERIMENT"):
        Tables.load(path.parent)
    (folder / "tables" / "accounting.csv").write_bytes(b"\xff")
    with pytest.raises(DamagedError, match=r"accounting\.csv: cannot be read"):
        started_in(folder)


def test_a_command_ends_with_the_file_and_the_remedy(folder, tmp_path):
    change(folder / "tables" / "runs.parquet", 1000)
    answer = CliRunner().invoke(app, ["tables", str(folder / "tables"), str(tmp_path / "csv")])
    assert answer.exit_code == 2
    assert f"error: {folder / 'tables' / 'runs.parquet'}: damaged" in answer.output


def test_comparing_recording_and_repeating_refuse_damaged_tables(folder):
    exact.read(folder)
    change(folder / "tables" / "provenance.json", 50)
    for read in (
        lambda: exact.read(folder),
        lambda: recording.of_results(folder),
        lambda: replay.Repetition.of("none", results=folder.parent),
    ):
        with pytest.raises(DamagedError, match=REFUSED.format("provenance.json")):
            read()


def test_a_list_of_blocks_with_a_changed_byte_is_refused(tmp_path):
    path = tmp_path / "needs.json"
    Needs({"noise": {"icp": 12}}).write(path)
    Needs({"noise": {"icp": 13}}).write(path)  # the last checksum counts
    assert Needs.read(path).trials == {"noise": {"icp": 13}}
    for _ in changes(path, range(path.stat().st_size)):
        with pytest.raises(ConfigError, match=r"needs\.json: damaged, .*; remove it"):
            Needs.read(path)
    change(path, path.read_bytes().index(b"3"))
    assert set_aside_damaged(tmp_path) == [path]


def test_small_files_of_earlier_versions_are_not_set_aside(tmp_path):
    (tmp_path / "needs.json").write_text("{}")
    (tmp_path / "accounting.csv").write_text("method\n")
    assert not is_damaged(tmp_path / "needs.json")
    assert set_aside_damaged(tmp_path) == []


def test_collecting_evidence_sets_damaged_tables_aside_before_it_reads_them(folder, monkeypatch):
    monkeypatch.setattr(reports.campaign.run, "collect", lambda *_: None)
    evidence = folder / "evidence"
    evidence.mkdir()
    (folder / "tables").rename(evidence / "tables")
    Needs({"noise": {"icp": 1}}).write(evidence / "needs.json")
    change(evidence / "tables" / "runs.parquet", 1000)
    change(evidence / "needs.json", 3)
    command = ["evidence", "--experiments", EXPERIMENT, "--directory", str(folder.parents[1])]
    answer = CliRunner().invoke(app, [*command, "--hours", "0"])  # which only shows
    assert (answer.exit_code, (evidence / "needs.json").is_file()) == (0, True)
    answer = CliRunner().invoke(app, command)
    assert answer.exit_code == 0, answer.output
    assert f"damaged   {evidence / 'needs.json'}: renamed" in answer.output
    assert sorted(path.name for path in evidence.iterdir()) == [SUMS, f"needs.json{DAMAGED}"]
