"""Archives of results: what is kept, what is refused, and the pages that they give."""

from __future__ import annotations

import json
import re
import shutil
import zipfile
from pathlib import Path

import pandas as pd
import pytest
from pandas.testing import assert_frame_equal
from report_fixture import write_tables

from reports.archive import clouds as archived_clouds
from reports.archive import crate, pages, read
from reports.archive import write as writing
from reports.runs import clouds as drawn_clouds
from reports.tables import STORED_EVENTS, ReportError, Tables, thinned
from workflows import provenance, records
from workflows.archives import ArchiveError, archived
from workflows.blocks import FORECASTS, NEEDS
from workflows.integrity import digest, set_aside_damaged
from workflows.outcomes import STARTED
from workflows.stages.clouds import CLOUDS


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("results")
    for name in ("one", "two"):
        write_tables(root / name / "tables", name)
    (root / "bounds").mkdir()
    pd.DataFrame({"bound": ["dc", "tight"], "value": [0.5, 0.75]}).to_csv(
        root / "bounds" / "boxes.csv", index=False
    )
    (root / "bounds" / "provenance.json").write_text(
        json.dumps({"time_s": 6.0, **provenance.origin()})
    )
    return root


@pytest.fixture(scope="module")
def archive(results, tmp_path_factory) -> Path:
    return writing.write([results], tmp_path_factory.mktemp("archives") / "1.0", "1.0")


def test_restored_tables_are_those_of_the_results(results, archive, tmp_path):
    places = read.restore(archive, tmp_path)
    assert [place.parent.name for place in places] == ["one", "two"]
    for place in places:
        stored, original = Tables.load(place), Tables.load(results / place.parent.name / "tables")
        assert_frame_equal(stored.runs, original.runs)
        assert_frame_equal(stored.accounting, original.accounting)
        assert_frame_equal(stored.traces, thinned(original.traces))
        assert (stored.provenance, stored.overlays) == (original.provenance, original.overlays)
        assert drawn_clouds.of_instances(stored) == drawn_clouds.of_instances(original)
    assert set_aside_damaged(tmp_path) == []
    study = pd.read_csv(tmp_path / "bounds" / "boxes.csv")
    assert_frame_equal(study, pd.read_csv(results / "bounds" / "boxes.csv"))
    known = json.loads((tmp_path / "bounds" / "provenance.json").read_text())
    assert known["machine"] == provenance.machine_card()
    assert known["git"]["commit"] == provenance.git_state()["commit"]
    assert known["time_s"] == 6.0


def test_a_new_archive_keeps_experiments_without_new_results(results, tmp_path):
    earlier, later = tmp_path / "earlier", tmp_path / "later"
    shutil.copytree(results, earlier)
    (earlier / "two" / NEEDS).write_text('{"kept": 1}')
    (later / "two").mkdir(parents=True)  # begun, without tables
    write_tables(later / "one" / "tables", "one")
    out = writing.write([earlier], tmp_path / "1.0", "1.0")
    before = {name: read.facts(out)["experiments"][name] for name in ("one", "two")}
    stored = (out / "experiments" / "two" / "overlays.json.gz").read_bytes()
    writing.write([later], out, "1.0")
    read.check(out)
    assert read.facts(out)["experiments"] == before
    assert (out / "experiments" / "two" / "overlays.json.gz").read_bytes() == stored
    assert (out / "experiments" / "two" / NEEDS).read_text() == '{"kept": 1}'
    assert (out / "bounds" / "boxes.parquet").is_file()


def test_fewer_results_replace_an_archive_only_on_request(results, tmp_path):
    fewer = tmp_path / "fewer"
    write_tables(fewer / "one" / "tables", "one")
    path = fewer / "one" / "tables" / "accounting.csv"
    accounting = pd.read_csv(path)
    accounting[["finished", "not_needed"]] = accounting[["not_needed", "finished"]].to_numpy()
    accounting.to_csv(path, index=False)
    out = writing.write([results], tmp_path / "1.0", "1.0")
    with pytest.raises(ReportError, match="would be lost; choose another name"):
        writing.write([fewer], out, "1.0")
    read.check(out)
    # on request only the next check, of the tables, refuses them
    with pytest.raises(ReportError, match="run the experiment again"):
        writing.write([fewer], out, "1.0", replace=True)
    writing.write([results], out, "1.0")


def test_archived_clouds_are_thinned_with_the_pairs_that_remain(results, tmp_path, monkeypatch):
    tables = Tables.load(results / "one" / "tables")
    original = pd.read_parquet(tables.directory / CLOUDS).set_index("instance_id")
    (tmp_path / "experiments" / "one").mkdir(parents=True)
    monkeypatch.setattr(archived_clouds, "MOST_POINTS", 40)
    counts = archived_clouds.write([tables], tmp_path, 10**9)
    assert counts == {"one": {"stored": len(original), "of": len(original)}}
    table = pd.read_parquet(tmp_path / "experiments" / "one" / CLOUDS)
    assert list(table["instance_id"]) == list(original.index)
    for name, dim, source, target, pairs in table.itertuples(index=False):
        assert len(source) == len(target) == 40 * dim
        whole = original.loc[name, "source"].reshape(-1, dim).tolist()
        assert all(point in whole for point in source.reshape(-1, dim).tolist())
        assert len(pairs) == 2 * 40  # each point of these clouds has its partner
        assert pairs.max() < 40


def test_clouds_that_do_not_fit_are_left_out_and_named(results, archive, tmp_path, monkeypatch):
    clouds = sum(path.stat().st_size for path in archive.rglob(CLOUDS))
    rest = sum(path.stat().st_size for path in archive.rglob("*") if path.is_file()) - clouds
    monkeypatch.setattr(writing, "MOST_BYTES", int((rest + 0.4 * clouds) / 0.9))
    own = writing.write([results], tmp_path / "own", "1.0")
    crate.check(own)
    read.folder_of(str(own), tmp_path)
    counts = [one["clouds"] for one in read.facts(own)["experiments"].values()]
    assert 0 < counts[0]["stored"] < counts[0]["of"]
    said = list(archived_clouds.sentences(read.facts(own)))
    assert f"{counts[0]['stored']} of {counts[0]['of']} instances of one" in said[0]
    (place,) = read.restore(own, tmp_path / "restored", only="one")
    assert len(pd.read_parquet(place / CLOUDS)) == counts[0]["stored"]
    known = drawn_clouds.of_instances(Tables.load(place))
    kinds = {one["kind"] for one in known.values()}
    assert kinds == {drawn_clouds.TRUE, drawn_clouds.NEAREST}  # others are those of the overlays


def test_an_archived_optimum_without_a_lower_bound_is_restored_as_converged(results, tmp_path):
    own = _copy(results, tmp_path / "results")
    path = own / "one" / "tables" / "runs.parquet"
    runs = records.read(path, records.runs_columns())
    at = runs.index[runs["status"] == "optimal"][0]
    runs.loc[at, "bound_ratio"] = 0.0
    records.write(runs, path)
    archive = writing.write([own], tmp_path / "archive", "1")
    (place,) = read.restore(archive, tmp_path / "out", only="one")
    restored = Tables.load(place).runs.set_index("run_id")["status"]
    assert restored[runs.loc[at, "run_id"]] == "converged"
    assert (restored == "optimal").sum() == (runs["status"] == "optimal").sum() - 1


def test_the_committed_archive_is_valid_and_has_all_clouds(tmp_path):
    folder = read.folder_of("0.2.0", tmp_path)  # whose checksums hold
    crate.check(folder)
    facts = read.facts(folder)
    assert all(
        (folder / "experiments" / name / "clouds.parquet").is_file()
        for name in facts["experiments"]
    )
    del facts["experiments"]["findings"]["clouds"]
    said = list(archived_clouds.sentences(facts))
    assert said == ["Clouds of experiment findings are only in its overlays."]


def test_histories_keep_their_ends_and_at_most_the_stated_events():
    many = 10 * STORED_EVENTS
    events = pd.DataFrame(
        {"run_id": ["a"] * many + ["b"], "time_s": [*range(many), 0], "lower_bound": [*range(many), 0],
         "upper_bound": 1.0, "stage": ["start"] + ["search"] * (many - 1) + ["search"]}
    )  # fmt: skip
    kept = thinned(events)
    assert kept["run_id"].value_counts()["a"] <= STORED_EVENTS
    assert set(kept["run_id"]) == {"a", "b"}
    assert list(kept["time_s"].iloc[[0, -2]]) == [0, many - 1]
    flat = pd.DataFrame(
        {"run_id": "a", "stage": ["translation"] * 3 + ["rotation"] * 2, "time_s": range(5),
         "lower_bound": 0.0, "upper_bound": 1.0}
    )  # fmt: skip
    assert list(thinned(flat)["time_s"]) == [0, 2, 4]  # no bound changes, but a stage ends


def test_an_archive_of_the_same_results_has_the_same_tables(results, archive, tmp_path):
    again = writing.write([results], tmp_path / "again", "1.0")
    names = [path.relative_to(archive) for path in archive.rglob("*") if path.is_file()]
    same = [name for name in names if "crate" not in name.name and name.suffix != ".sha256"]
    for name in set(same) - {Path("archive.json")}:  # which states when it was made
        assert (again / name).read_bytes() == (archive / name).read_bytes(), name


def test_every_file_is_described(archive):
    crate.check(archive)
    described = json.loads((archive / crate.METADATA).read_text())["@graph"]
    runs = next(entity for entity in described if entity["@id"] == "runs.parquet")
    assert runs["encodingFormat"] == "application/vnd.apache.parquet"


def _copy(archive: Path, to: Path) -> Path:
    for path in archive.rglob("*"):
        if path.is_file():
            place = to / path.relative_to(archive)
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(path.read_bytes())
    return to


def test_a_file_without_a_description_is_refused(archive, tmp_path):
    own = _copy(archive, tmp_path / "own")
    (own / "more.json").write_text("{}")
    with pytest.raises(ReportError, match=r"more\.json is not described"):
        crate.check(own)


@pytest.mark.parametrize(
    "name", ["runs.parquet", "archive.json", "experiments/one/provenance.json"]
)
def test_a_damaged_or_missing_file_is_refused(archive, tmp_path, name):
    own = _copy(archive, tmp_path / "own")
    content = (own / name).read_bytes()
    (own / name).write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(ArchiveError, match=f"{Path(name).name}: damaged"):
        read.folder_of(str(own), tmp_path)
    (own / name).unlink()
    with pytest.raises(ArchiveError, match="missing"):
        read.folder_of(str(own), tmp_path)


def test_a_file_without_a_checksum_is_refused(archive, tmp_path):
    own = _copy(archive, tmp_path / "own")
    (own / ".DS_Store").touch()
    assert read.folder_of(str(own), tmp_path) == own
    (own / "evidence").mkdir(exist_ok=True)
    (own / "evidence" / "verdicts.csv").write_text("claim\n")
    with pytest.raises(ArchiveError, match=r"verdicts\.csv: not listed in checksums\.sha256"):
        read.folder_of(str(own), tmp_path)


def test_another_schema_is_refused(archive, tmp_path, monkeypatch):
    monkeypatch.setattr(records, "SCHEMA_VERSION", records.SCHEMA_VERSION + 1)
    with pytest.raises(records.SchemaError, match="read it with the checkout that wrote it"):
        read.folder_of(str(archive), tmp_path)


def _zipped(archive: Path, path: Path) -> Path:
    with zipfile.ZipFile(path, "w") as packed:
        for file in archive.rglob("*"):
            packed.write(file, Path("1.0") / file.relative_to(archive))
    return path


def test_a_zip_file_is_read_if_its_checksum_is_right(archive, tmp_path):
    packed = _zipped(archive, tmp_path / "results.zip")
    folder = read.folder_of(str(packed), tmp_path / "cache", digest(packed))
    assert read.facts(folder)["version"] == "1.0"
    with pytest.raises(ReportError, match=r"results\.zip: SHA-256 is"):
        read.folder_of(str(packed), tmp_path / "cache", "0" * 64)
    with pytest.raises(ReportError, match="that of a zip file, and this is a folder"):
        read.folder_of(str(folder), tmp_path / "cache", digest(packed))


@pytest.mark.parametrize("name", ["../out.txt", "/out.txt", "a/../../out.txt", "..\\out.txt"])
def test_a_zip_file_cannot_write_outside_its_folder(archive, tmp_path, name):
    packed = _zipped(archive, tmp_path / "results.zip")
    with zipfile.ZipFile(packed, "a") as more:
        more.writestr(name, "x")
    with pytest.raises(ReportError, match="unsafe member"):
        read.folder_of(str(packed), tmp_path / "cache")
    assert not list(tmp_path.rglob("out.txt"))


def test_a_zip_file_with_a_link_is_refused(archive, tmp_path):
    packed = _zipped(archive, tmp_path / "results.zip")
    with zipfile.ZipFile(packed, "a") as more:
        link = zipfile.ZipInfo("1.0/link")
        link.external_attr = 0o120777 << 16
        more.writestr(link, "/etc/passwd")
    with pytest.raises(ReportError, match="unsafe member"):
        read.folder_of(str(packed), tmp_path / "cache")


def test_a_zip_file_that_would_fill_the_disk_is_refused(archive, tmp_path, monkeypatch):
    monkeypatch.setattr(read, "MOST_UNPACKED", 1000)
    with pytest.raises(ReportError, match="unpacked, more than"):
        read.folder_of(str(_zipped(archive, tmp_path / "results.zip")), tmp_path / "cache")


def test_an_archive_is_downloaded_once_if_its_checksum_and_size_are_right(
    archive, tmp_path, serve, monkeypatch
):
    packed = _zipped(archive, tmp_path / "results.zip")
    address, asked = serve(tmp_path)
    url, cache = f"{address}/results.zip", tmp_path / "cache"
    with pytest.raises(ReportError, match=r"SHA-256 is [0-9a-f]{64}, not 0{64}; not kept"):
        read.folder_of(url, cache, "0" * 64)
    monkeypatch.setattr(read, "MOST_DOWNLOADED", packed.stat().st_size - 1)
    with pytest.raises(ReportError, match="more than"):
        read.folder_of(url, cache, digest(packed))
    assert list(cache.iterdir()) == []
    monkeypatch.undo()
    for _ in range(2):
        assert read.facts(read.folder_of(url, cache, digest(packed)))["version"] == "1.0"
    assert len(asked) == 3
    with pytest.raises(ReportError, match="404"):
        read.folder_of(f"{address}/absent.zip", cache, "1" * 64)


def _seal(folder: Path) -> None:
    (folder / "checksums.sha256").unlink()
    writing._write_checksums(folder)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("runs.parquet", b"PAR1", "cannot be read"),
        ("archive.json", b"[1]", "states no date"),
        ("archive.json", b"\xff", "cannot be read"),
        ("experiments/one/overlays.json.gz", b"x", "cannot be read"),
    ],
)
def test_a_damaged_file_with_a_right_checksum_is_refused(archive, tmp_path, name, content, words):
    own = _copy(archive, tmp_path / "own")
    (own / name).write_bytes(content)
    _seal(own)
    with pytest.raises(ArchiveError, match=words):
        read.restore(read.folder_of(str(own), tmp_path), tmp_path / "out")


def test_the_name_of_an_experiment_cannot_leave_the_folder(archive, tmp_path):
    own = _copy(archive, tmp_path / "own")
    runs = pd.read_parquet(own / "runs.parquet")
    runs.assign(experiment="../one").to_parquet(own / "runs.parquet")
    with pytest.raises(ReportError, match="unsafe name"):
        read.restore(own, tmp_path / "out")
    assert not (tmp_path / "one").exists()


def test_an_archive_without_its_tables_is_refused(archive, tmp_path):
    own = _copy(archive, tmp_path / "own")
    (own / "traces.parquet").unlink()
    _seal(own)
    with pytest.raises(ArchiveError, match=r"does not list traces\.parquet"):
        read.folder_of(str(own), tmp_path)


def test_an_address_needs_a_checksum(tmp_path):
    with pytest.raises(ReportError, match="SHA-256"):
        read.folder_of("https://example.org/results.zip", tmp_path)


@pytest.mark.parametrize(
    "archive",
    ["1.0", "some/1.0", "some/1.0/", "1.0.zip", "https://example.org/1.0.zip?download=1&x=2"],
)
def test_the_name_of_an_archive_is_that_of_its_folder_or_file(archive):
    assert read.name_of(archive) == "1.0"


def test_an_unknown_version_is_refused_with_those_that_exist(tmp_path):
    with pytest.raises(ReportError, match="no such archive; stored versions"):
        read.folder_of("0.0.0", tmp_path)


def test_results_that_would_be_too_large_are_refused(results, tmp_path, monkeypatch):
    monkeypatch.setattr(writing, "MOST_BYTES", 1000)
    with pytest.raises(ReportError, match="archive fewer experiments"):
        writing.write([results], tmp_path / "2.0", "2.0")
    assert not (tmp_path / "2.0").exists()


def test_no_results_are_refused(tmp_path):
    with pytest.raises(ReportError, match="no results"):
        writing.write([tmp_path], tmp_path / "2.0", "2.0")


@pytest.mark.usefixtures("blank_prints")
def test_all_pages_are_built_from_an_archive(archive, tmp_path):
    index = pages.build(str(archive), tmp_path / "pages")
    text = index.read_text()
    reports = [f"{name}/report/index.html" for name in ("one", "two")]
    assert "python -m reports library" in text
    for link in (*reports, "claims/claims.html", "figures/index.html"):
        assert f'href="{link}"' in text
        assert (index.parent / link).is_file()
    runs = pd.read_parquet(archive / "runs.parquet")
    outcomes = runs.loc[runs["experiment"] == "one", "outcome"].value_counts()
    row = text.split(f'href="{reports[0]}"')[1].split("</tr>")[0]
    shown = [int(count) for count in re.findall(r'<td class="n"[^>]*>(\d+)</td>', row)]
    titles = re.findall(r'<th scope="col" class="n">(.*?)</th>', text)
    stated = dict(zip(titles, shown, strict=True))
    assert stated.pop("planned runs") == sum(shown[1:]) == outcomes.sum()
    assert {name: n for name, n in stated.items() if n} == {
        name.replace("_", " "): n for name, n in outcomes.items()
    }
    report = (index.parent / reports[0]).read_text(encoding="utf-8")
    assert 'href="../../history/index.html"' in report


def test_archived_runs_are_found_again_with_their_histories(results, archive, monkeypatch):
    monkeypatch.setenv("DCREG_ARCHIVES", str(archive.parent))
    tables = Tables.load(results / "two" / "tables")
    for name, own in tables.runs.groupby("method"):
        usable = own[own["outcome"].isin(STARTED)].drop_duplicates("run_id")
        found = archived(str(name))
        assert {key[0] for key in found} == set(usable["run_id"])
        for row in found.values():
            (original,) = usable[usable["run_id"] == row["run_id"]].to_dict("records")
            assert all(original[column] == row[column] for column in row if column != "trace")
            events = tables.traces[tables.traces["run_id"] == row["run_id"]]
            kept = thinned(events)["upper_bound"].dropna().tolist()
            assert [
                event["upper_bound"] for event in row["trace"] if "upper_bound" in event
            ] == kept
    monkeypatch.setenv("DCREG_ARCHIVES", "")
    assert archived("dcreg") == {}


def test_no_run_is_taken_from_a_damaged_archive(archive, tmp_path, monkeypatch):
    own = _copy(archive, tmp_path / "archives" / "own")
    (own / "traces.parquet").write_bytes(b"")
    monkeypatch.setenv("DCREG_ARCHIVES", str(own.parent))
    with pytest.raises(ArchiveError, match="damaged"):
        archived("dcreg")


@pytest.mark.parametrize("hours", ["hours of runs", "hours of CPU"])
def test_the_page_states_what_open_claims_need_only(hours, tmp_path):
    (tmp_path / "claims").mkdir()
    (tmp_path / "evidence").mkdir()
    judged = {"faster": "open", "tighter-bnb": "reproduced", "low-overlap": "not run"}
    pd.DataFrame(judged.items(), columns=["id", "verdict"]).to_csv(
        tmp_path / "claims" / "claims.csv"
    )
    needs = pd.DataFrame(
        {"claim": list(judged), "verdict": ["open", None, None], hours: [2.5, None, None],
         "obstacle": ["", "make bounds", "make threedmatch"]}
    )  # fmt: skip
    needs.to_csv(tmp_path / "evidence" / "open.csv", index=False)
    columns = ("claim", "verdict", "hours of runs", "obstacle")  # those that the template reads
    found = [tuple(row[name] for name in columns) for row in pages._open(tmp_path)]
    assert found == [
        ("faster", "open", "2.5", ""),
        ("low-overlap", "not run", "", "make threedmatch"),
    ]


def test_a_published_archive_has_no_experiment_that_was_deleted(results, tmp_path):
    out, rest = tmp_path / "1", _copy(results / "one", tmp_path / "rest" / "one").parent
    for keep, names in ((True, ["one", "two"]), (False, ["one"])):
        writing.write([results], out, "1", replace=True)
        writing.write([rest], out, "1", replace=True, keep=keep)
        assert sorted(path.name for path in (out / "experiments").iterdir()) == names


def test_evidence_of_one_experiment_keeps_the_times_of_others(results, tmp_path):
    own, out = _copy(results, tmp_path / "results"), tmp_path / "archive"
    (own / "evidence").mkdir()
    for name, text in (("two.times", "earlier"), ("one.times", "a"), ("one.times", "b")):
        (own / "evidence" / f"{name}.csv").write_text(text)
        writing.write([own], out, "1")
        (own / "evidence" / f"{name}.csv").unlink()
    stored = {path.name: path.read_text() for path in (out / "evidence").iterdir()}
    assert stored == {"two.times.csv": "earlier", "one.times.csv": "b"}


def test_an_archive_names_the_machines_of_its_runs(results, tmp_path):
    own = _copy(results, tmp_path / "results")
    path = own / "one" / "tables" / "runs.parquet"
    runs = pd.read_parquet(path)
    started = runs["outcome"].isin(STARTED)
    runs["machine_id"] = "e5e579a0"  # of the recorded versions
    runs.loc[runs.index[started][:2], "machine_id"] = "gone"
    runs.to_parquet(path)
    found = {
        each["machine_id"]: each for each in writing._machines([Tables.load(path.parent)], own)
    }
    assert found["gone"]["cpu"] == "unknown processor"
    assert found["gone"]["runs"] == 2
    assert found["e5e579a0"]["cpu"] == "AMD EPYC"
    assert sum(each["runs"] for each in found.values()) == started.sum()


def test_forecast_and_actual_time_of_evidence_are_archived_and_shown(results, tmp_path):
    own = _copy(results, tmp_path / "results")
    (own / "evidence").mkdir()
    log = pd.DataFrame(
        {"experiment": "one", "claim": ["a", "b", "c"], "runs": [4, 4, 1], "planned": [None, 4, 4],
         "forecast_s": [3600.0, 1800.0, 9e9], "actual_s": [1800.0, 900.0, 1.0]}
    )  # fmt: skip
    log.to_csv(own / "evidence" / FORECASTS, index=False)
    archive = writing.write([own], tmp_path / "archive", "1")
    crate.check(archive)
    read.restore(archive, tmp_path / "out")
    assert pages._forecasts(tmp_path / "out" / "evidence" / FORECASTS) == [
        {"experiment": "one", "forecast_s": 1.5, "actual_s": 0.75, "steps": 2}
    ]


def test_a_method_may_be_named_by_a_number(tmp_path):
    folder = write_tables(tmp_path / "tables", "one")
    runs = pd.read_parquet(folder / "runs.parquet")
    number = {str(runs["method"].iloc[0]): "7"}
    runs.assign(method=runs["method"].replace(number)).to_parquet(folder / "runs.parquet")
    counts = pd.read_csv(folder / "accounting.csv")
    counts = counts[counts["method"].isin(number)].assign(method="7")
    counts.to_csv(folder / "accounting.csv", index=False)
    runs = pd.read_parquet(folder / "runs.parquet")
    runs[runs["method"] == "7"].to_parquet(folder / "runs.parquet")
    assert list(Tables.load(folder).accounting["method"]) == ["7"]
