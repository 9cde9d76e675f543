"""The problem library: files, records, checks, submissions and solves."""

import hashlib
import json
import re
import shutil
from dataclasses import asdict, replace

import jsonschema
import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import dcreg
from data import fetch
from data.contract import DataError
from data.library import check, evaluate, matchings, record, submit
from data.library.__main__ import app
from data.library.check import faulty_poses, faulty_proof, sampled_proofs
from data.library.problem import (
    HERE,
    PROBLEMS,
    LibraryError,
    Problem,
    all_problems,
    changed_files,
    checksums,
    find_problem,
    read_problem,
    write_problem,
)
from data.library.record import (
    PROOFS,
    BoundEntry,
    Enumeration,
    PoseEntry,
    Proof,
    Record,
    SolveEntry,
    own_command,
    read_record,
)
from tests.oracles.kernels import k_assignment
from tests.oracles.matchings import optimal_similarity
from workflows.library import solve as solving
from workflows.library.constructions import solid, tiny
from workflows.library.generate import as_problem
from workflows.library.recording import record_answers
from workflows.library.running import instance_of, judged, summary
from workflows.library.solve import reprove, solve

KNOWN = all_problems()
RECORDS = {problem_id: read_record(problem_id) for problem_id in KNOWN}
ONE = find_problem("fish-60-noise-03")
ROOT = HERE.parents[1]
AUTHOR = {"by": "test", "date": "2026-11-26", "how": "a test"}


# --- files ---------------------------------------------------------------------------------------


def test_no_problem_has_changed_and_all_are_listed():
    found = checksums()
    assert changed_files(found) == []
    assert set(found) == set(json.loads((HERE / "checksums.json").read_text(encoding="utf-8")))
    found[ONE.id] = "0" * 64
    assert changed_files(found)[0].startswith(f"{ONE.id}: its file is changed; restore it")
    del found[ONE.id]
    assert "is missing" in changed_files(found)[0]


def test_exported_clouds_are_those_of_the_problem(tmp_path):
    answer = CliRunner().invoke(app, ["export", ONE.name, str(tmp_path)])
    assert f"--n-inliers {ONE.n_inliers}" in answer.stdout
    for cloud, name in zip(ONE.clouds, ("source.txt", "target.txt"), strict=True):
        np.testing.assert_array_equal(dcreg.read_points(tmp_path / name), cloud)


@pytest.mark.parametrize(
    ("name", "kind"),
    [("problem", Problem), ("record", Record), ("submission", submit.Submission)],
)
def test_schemas_are_those_of_the_classes(name, kind):
    schema = json.loads((HERE / f"{name}.schema.json").read_text(encoding="utf-8"))
    assert schema == kind.model_json_schema(), "run python -m data.library schema"


def test_files_are_valid_under_their_schemas():
    for name, folder in (("problem", PROBLEMS), ("record", record.RECORDS)):
        schema = json.loads((HERE / f"{name}.schema.json").read_text(encoding="utf-8"))
        check = jsonschema.Draft202012Validator(schema)
        for path in sorted(folder.glob("*.json"))[::25]:
            check.validate(json.loads(path.read_text(encoding="utf-8")))


def test_the_library_is_as_large_and_as_small_as_promised():
    problems = list(KNOWN.values())
    statuses = {problem.id: RECORDS[problem.id].status(problem) for problem in problems}
    proven = [problem for problem in problems if statuses[problem.id] != "open"]
    assert len(problems) >= 200
    assert sum(problem.family == "tiny" for problem in problems) <= 40
    assert sum(min(problem.n_source, problem.n_target) >= 60 for problem in problems) >= 100
    assert len(problems) - len(proven) >= 20
    assert len(proven) >= 120
    assert sum(problem.dim == 3 for problem in proven) >= 60
    assert all(record.best_pose for record in RECORDS.values())
    assert sum(path.stat().st_size for path in HERE.rglob("*") if path.is_file()) < 20e6


def test_third_party_points_are_not_stored():
    for problem in KNOWN.values():
        assert (problem.licence == "MIT") == (problem.source_points is not None)


def test_a_file_gives_the_same_problem_and_cannot_be_replaced(tmp_path):
    path = write_problem(ONE, tmp_path)
    assert read_problem(path) == ONE
    assert path.read_bytes() == (PROBLEMS / path.name).read_bytes()
    with pytest.raises(LibraryError, match=r"problems never change, so use version 2"):
        write_problem(ONE.model_copy(update={"title": "another"}), tmp_path)


@pytest.mark.parametrize("draft", [tiny(0), solid("cube", 0.1)], ids=lambda draft: draft.name)
def test_constructions_give_the_stored_points(draft):
    stored = find_problem(draft.name)
    assert as_problem(draft).source_sha256 == stored.source_sha256
    assert as_problem(draft).target_sha256 == stored.target_sha256


def test_changed_points_and_bad_fields_are_refused(tmp_path):
    rows = [[0.0, 0.0], *ONE.source_points[1:]]
    with pytest.raises(LibraryError, match="source has the checksum"):
        _ = Problem.model_validate({**ONE.model_dump(by_alias=True), "source": rows}).clouds
    path = tmp_path / f"{ONE.id}.json"
    path.write_text(ONE.text().replace('"n_inliers": 60', '"n_inliers": 0'), encoding="utf-8")
    with pytest.raises(LibraryError, match=r"n_inliers: Input should be greater"):
        read_problem(path)
    with pytest.raises(LibraryError, match="similar: fish-60-noise-03@1"):
        find_problem("fish-60-noise-3@1")


# --- records -------------------------------------------------------------------------------------


@pytest.mark.parametrize("problem_id", sorted(KNOWN)[::20])
def test_stored_poses_have_the_stored_objective(problem_id):
    problem = KNOWN[problem_id]
    if not problem.needs_files:
        assert faulty_poses(problem, RECORDS[problem_id]) == []


def test_the_plain_evaluator_agrees_with_the_oracle():
    source, target = ONE.clouds
    pose = np.array(RECORDS[ONE.id].best_pose.pose)
    moved = source @ pose[:2, :2].T + pose[:2, 2]
    cost = ((moved[:, None] - target) ** 2).sum(axis=2)
    for k in (60, 41, 7):
        assert evaluate.plain_objective(source, target, pose, k) == pytest.approx(
            k_assignment(cost, k), rel=1e-12
        )


def test_a_wrong_objective_and_a_bound_above_it_are_found():
    pose = RECORDS[ONE.id].best_pose
    wrong = Record(problem=ONE.id, entries=[pose.model_copy(update={"objective": 0.1})])
    assert "is stored, but the pose of dcreg" in faulty_poses(ONE, wrong)[0]
    bound = RECORDS[ONE.id].best_bound.model_copy(update={"lower_bound": 2 * pose.objective})
    assert (
        "exceeds the objective"
        in faulty_poses(ONE, Record(problem=ONE.id, entries=[pose, bound]))[0]
    )


def test_stored_proofs_are_verified_and_a_changed_file_is_found(tmp_path):
    stored = RECORDS[ONE.id]
    assert faulty_proof(ONE, stored) == []
    name = submit.proof_path(ONE.id, stored.certificate.sha256, tmp_path).name
    shutil.copyfile(PROOFS / name, tmp_path / name)
    with (tmp_path / name).open("ab") as file:
        file.write(b"0")
    assert "is not the file that was accepted" in faulty_proof(ONE, stored, tmp_path)[0]
    assert len(sampled_proofs(KNOWN)) >= 20


def planted(command):
    """A record of an open problem with a high bound whose stated proof does not exist."""
    problem = find_problem("overlap-fish-60-30")
    poses = Record(problem=problem.id, entries=RECORDS[problem.id].poses)
    proof = Proof(
        sha256="0" * 64, size=10**6, n_leaves=1, stored=False, command=command, check_s=1.0
    )
    bound = BoundEntry(**AUTHOR, lower_bound=0.999 * poses.objective, proof=proof)
    solve = SolveEntry(**AUTHOR, options={}, status="optimal", cpu_s=1.0)
    return problem, poses.with_entries(bound, solve)


@pytest.fixture
def checked_record(monkeypatch):
    """Check a library that consists of one problem with the given record."""

    def checked(problem, given, *options):
        monkeypatch.setattr(check, "checksums", lambda: {problem.id: checksums()[problem.id]})
        monkeypatch.setattr(check, "changed_files", lambda _: [])
        for module in (check, solving):
            monkeypatch.setattr(module, "read_record", lambda _: given)
        return CliRunner().invoke(app, ["check", *options])

    return checked


@pytest.mark.parametrize("options", [[], ["--all"]])
def test_a_bound_without_a_proof_is_a_fault(checked_record, options):
    problem, given = planted("evil --prove")
    answer = checked_record(problem, given, *options)
    assert answer.exit_code == 1
    assert "its command is 'evil --prove', not 'python -m workflows" in answer.stdout
    ((line, holds),) = reprove([problem], 1.0)
    assert not holds, line
    lost = given.best_bound.proof.model_copy(update={"stored": True})
    given = given.with_entries(given.best_bound.model_copy(update={"proof": lost}))
    given = Record(problem=problem.id, entries=[*given.poses, given.bounds[-1]])
    assert "no such file" in checked_record(problem, given, *options).stdout
    tried = given.best_bound.model_copy(update={"proof": Enumeration(n_matchings=1)})
    given = Record(problem=problem.id, entries=[*given.poses, tried])
    assert "for tiny problems only" in checked_record(problem, given, *options).stdout


def test_the_own_command_does_not_prove_a_planted_bound(monkeypatch):
    problem, given = planted(own_command(find_problem("overlap-fish-60-30").id))
    monkeypatch.setattr(solving, "read_record", lambda _: given)
    ((line, holds),) = reprove([problem], 0.2)
    assert not holds, line


def test_only_solves_by_dcreg_make_a_problem_easy():
    _, given = planted("")
    own = given.solves[0].model_copy(update={"by": "dcreg 0.2.0"})
    assert given.easy_solve() is None
    assert given.with_entries(own).easy_solve() == own
    assert given.tried_s == 1.0


def test_a_check_says_what_it_skipped(checked_record, monkeypatch):
    large = find_problem("tiny-2d-line-4")
    answer = checked_record(large, RECORDS[large.id], "--all")
    assert answer.exit_code == 0
    assert "skipped   1 proofs: not stored" in answer.stdout
    assert "0 of 1 proofs; 0 faults" in answer.stdout
    assert "not in the sample" in checked_record(ONE, RECORDS[ONE.id]).stdout

    def offline(_):
        raise DataError("no network")

    monkeypatch.setattr(check, "read_problem", offline)
    answer = checked_record(ONE, RECORDS[ONE.id])
    assert answer.exit_code == 0
    assert "skipped   1 problems: data not available" in answer.stdout


def test_hard_problems_were_tried_with_default_options():
    for problem in KNOWN.values():
        stored = RECORDS[problem.id]
        if stored.status(problem) == "hard":
            tried = [solve for solve in stored.solves if not solve.options]
            assert any(
                solve.status == "converged" or solve.cpu_s >= record.EASY_CPU_S for solve in tried
            ), problem.id


def test_unknown_statuses_are_refused():
    answer = CliRunner().invoke(app, ["list", "--status", "foo"])
    assert answer.exit_code == 2
    assert "--status foo: give one of easy, hard, open" in answer.stderr


def test_all_matchings_agree_with_the_oracle():
    problem = find_problem("tiny-2d-noisy-1")
    found = matchings.best_of_all_matchings(problem)
    oracle = optimal_similarity(*problem.clouds, problem.n_inliers, problem.scale_range)
    assert found.optimum == pytest.approx(oracle, rel=1e-9)
    assert RECORDS[problem.id].objective == pytest.approx(oracle, rel=1e-9)


def test_tiny_records_are_confirmed_by_all_matchings():
    tiny_ones = [
        problem
        for problem in KNOWN.values()
        if problem.family == "tiny" and problem.n_source * problem.n_target <= 20
    ]
    assert len(tiny_ones) >= 9
    for problem in tiny_ones:
        found = matchings.best_of_all_matchings(problem)
        stored = RECORDS[problem.id]
        assert stored.objective == pytest.approx(found.optimum, rel=1e-6)
        assert stored.lower_bound <= found.optimum * (1 + 1e-9)


# --- submissions ---------------------------------------------------------------------------------


@pytest.fixture
def place(tmp_path):
    """A folder of records with one that is worse than the best known pose, and without a bound."""
    pose = np.array(ONE.truth.pose)
    value = evaluate.evaluate(ONE, evaluate.admissible(ONE, pose))
    first = PoseEntry(**AUTHOR, objective=value, pose=pose.tolist())
    record.write_record(Record(problem=ONE.id, entries=[first]), tmp_path)
    return tmp_path


def submitted(place, **claims):
    content = {"format": "dcreg library submission", "problem": ONE.id, **AUTHOR, **claims}
    path = place / "submission.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    return submit.submit(path, place, place / "proofs")


def claim(pose, objective=None):
    given = np.array(pose)
    value = evaluate.evaluate(ONE, given) if objective is None else objective
    return {"better_pose": {"pose": given.tolist(), "objective": value}}


def test_a_better_pose_is_accepted_once(place):
    best = RECORDS[ONE.id].best_pose
    outcome = submitted(place, **claim(best.pose))
    assert outcome.refused == []
    assert "pose with objective" in outcome.accepted[0]
    assert read_record(ONE.id, place).objective == pytest.approx(best.objective, rel=1e-9)
    assert "is not below the best known one" in submitted(place, **claim(best.pose)).refused[0]
    assert len(read_record(ONE.id, place).entries) == 2


def test_false_poses_are_refused_with_the_reason(place):
    best = np.array(RECORDS[ONE.id].best_pose.pose)
    mirrored, shrunk, sheared = best.copy(), best.copy(), best.copy()
    mirrored[:2, 0] *= -1
    shrunk[:2, :2] *= 0.3 / np.sqrt(np.linalg.det(best[:2, :2]))
    far, huge = best.copy(), 1e200 * best
    far[0, 2], huge[2, 2] = 1e200, 1.0
    sheared[0, 1] += 0.1
    for pose, objective, reason in (
        (best, 0.01, "objective: 0.01 stated, but the pose has 0.164"),
        (mirrored, 0.01, "not a rotation times a scale"),
        (sheared, 0.01, "not a rotation times a scale"),
        (shrunk, 0.01, r"its scale is 0.3, outside scale_range"),
        (far, 0.01, "its translation exceeds 1e+100"),
        (huge, 0.01, "pose: "),
    ):
        outcome = submitted(place, **claim(pose, objective))
        assert outcome.accepted == []
        assert reason in outcome.refused[0]
    assert len(read_record(ONE.id, place).entries) == 1


def bound(place, certificate, lower_bound):
    dcreg.certificate.write(place / "proof.npz", certificate)
    return submitted(place, better_bound={"lower_bound": lower_bound, "proof": "proof.npz"})


def certificate_of(problem):
    proof = RECORDS[problem.id].certificate
    return dcreg.certificate.read(submit.proof_path(problem.id, proof.sha256))


def test_a_bound_is_accepted_with_its_proof_only(place):
    best = RECORDS[ONE.id].lower_bound
    proof = certificate_of(ONE)
    assert "stated, but the proof gives" in bound(place, proof, 1.005 * best).refused[0]
    outcome = bound(place, proof, best)
    assert outcome.refused == []
    assert read_record(ONE.id, place).lower_bound == best
    assert [path.name for path in (place / "proofs").iterdir()] == [
        submit.proof_path(ONE.id, read_record(ONE.id, place).certificate.sha256).name
    ]
    assert "is not above the best proven one" in bound(place, proof, best).refused[0]


def test_a_proof_may_already_be_where_it_is_stored(place):
    best = RECORDS[ONE.id].best_bound
    stored = submit.proof_path(ONE.id, best.proof.sha256)
    there = place / "proofs" / stored.name
    there.parent.mkdir()
    there.write_bytes(stored.read_bytes())
    claims = {"lower_bound": best.lower_bound, "proof": f"proofs/{stored.name}"}
    assert submitted(place, better_bound=claims).refused == []
    assert there.read_bytes() == stored.read_bytes()


def test_false_bounds_are_refused_with_the_reason(place):
    true = certificate_of(ONE)
    high = 1.5 * true.upper_bound
    planted = replace(
        true, lower_bound=high, upper_bound=high,
        leaf_bounds=np.where(np.isfinite(true.leaf_bounds), high, np.inf),
    )  # fmt: skip
    reason = bound(place, planted, high * true.unit**2).refused[0]
    assert "the checker rejects it" in reason
    cut = {
        name: getattr(true, name)[:-1]
        for name in ("leaf_lower", "leaf_upper", "leaf_bounds", "leaf_reasons")
    }
    assert "the checker rejects it" in bound(place, replace(true, **cut), 0.1).refused[0]
    other = certificate_of(find_problem("fish-60-noise-05"))
    assert "differs from the cloud" in bound(place, other, 0.1).refused[0]
    fewer = replace(true, n_inliers=59)
    assert "its model, n_inliers" in bound(place, fewer, 0.1).refused[0]
    missing = submitted(place, better_bound={"lower_bound": 0.1, "proof": "nothing.npz"})
    assert "no such file" in missing.refused[0]
    assert read_record(ONE.id, place).bounds == []


def test_an_easier_problem_of_the_same_name_is_not_accepted(place, monkeypatch):
    folder = place / "problems"
    folder.mkdir()
    easier = write_problem(ONE.model_copy(update={"n_inliers": 10}), folder)
    with pytest.raises(LibraryError, match="no problem"):
        submitted(place, **claim(np.eye(3), 1.0), problem=str(easier.with_suffix("")))
    changed = {**checksums(), ONE.id: hashlib.sha256(easier.read_bytes()).hexdigest()}
    monkeypatch.setattr(submit, "checksums", lambda: changed)
    with pytest.raises(LibraryError, match="its file is changed; restore it"):
        submitted(place, **claim(np.eye(3), 1.0))
    assert len(read_record(ONE.id, place).entries) == 1


def test_a_submission_says_what_is_wrong_with_it(place):
    with pytest.raises(LibraryError, match=r"better_pose\.objective: Input should be a finite"):
        submitted(place, **claim(RECORDS[ONE.id].best_pose.pose, np.inf))
    with pytest.raises(LibraryError, match="give at least one of them"):
        submitted(place)
    with pytest.raises(LibraryError, match=r"better_pose\.objective: Field required"):
        submitted(place, better_pose={"pose": [[1.0]]})
    for date in ("2026-99-99", "2026-02-30"):
        with pytest.raises(LibraryError, match="date: "):
            submitted(place, **claim(np.eye(3), 1.0), date=date)
    (place / "binary").write_bytes(b"\xff\xfe\x00")
    for path, reason in ((place, "cannot be read"), (place / "binary", "not a text file")):
        answer = CliRunner().invoke(app, ["submit", str(path)])
        assert (answer.exit_code, reason in answer.stderr) == (2, True), answer.stderr


def test_the_documented_example_has_the_documented_answer(tmp_path):
    text = (ROOT / "docs" / "library.md").read_text(encoding="utf-8")
    example = json.loads(text.split("```json\n")[1].split("```")[0])
    example["better_bound"]["proof"] = str(ROOT / example["better_bound"]["proof"])
    record.write_record(RECORDS[ONE.id], tmp_path)
    path = tmp_path / "my-submission.json"
    path.write_text(json.dumps(example), encoding="utf-8")
    outcome = submit.submit(path, tmp_path, tmp_path)
    assert outcome.accepted == []
    assert len(outcome.refused) == 2
    for line in outcome.refused:
        assert f"\nrefused   {line}\n" in text


def test_missing_data_of_a_problem_is_a_reason(place, monkeypatch):
    def offline(_):
        raise DataError("bunny: no network")

    submitted_path = place / "submission.json"
    submitted(place, **claim(RECORDS[ONE.id].best_pose.pose))
    monkeypatch.setattr(submit, "evaluate", lambda *_: offline(_))
    answer = CliRunner().invoke(app, ["submit", str(submitted_path)])
    assert answer.exit_code == 2
    assert "error: bunny: no network" in answer.stderr


def test_large_proofs_by_others_are_stored_and_own_ones_are_not(place, monkeypatch):
    monkeypatch.setattr(submit, "MAX_OWN", 10)
    proof, best = certificate_of(ONE), RECORDS[ONE.id].lower_bound
    dcreg.certificate.write(place / "proof.npz", proof)
    claims = {"lower_bound": 0.99 * best, "proof": "proof.npz", "command": own_command(ONE.id)}
    assert submitted(place, better_bound=claims).refused == []
    assert not read_record(ONE.id, place).certificate.stored
    claims |= {"lower_bound": best, "command": "my-solver --prove"}
    monkeypatch.setattr(submit, "MAX_OTHER", 10)
    assert "its command is not `python -m" in submitted(place, better_bound=claims).refused[0]
    monkeypatch.undo()
    assert submitted(place, better_bound=claims).refused == []
    assert read_record(ONE.id, place).certificate.stored


# --- solving and running -------------------------------------------------------------------------


def test_solves_are_kept_and_recorded(tmp_path):
    problem = find_problem("tiny-2d-regular-2")
    answers, records, proofs = (tmp_path / name for name in ("answers", "records", "proofs"))
    first = solve(problem, 20.0, answers)
    assert [answer.status for answer in first] == ["optimal", "optimal"]
    assert solve(problem, 20.0, answers) == [], "its answers are final"
    lines = list(record_answers([problem], answers, records, proofs))
    assert lines[0].startswith(f"{problem.id}: easy, gap ")
    made = read_record(problem.id, records)
    assert made.objective == pytest.approx(RECORDS[problem.id].objective, rel=1e-6)
    assert made.optima.count == RECORDS[problem.id].optima.count
    assert faulty_proof(problem, made, proofs) == []
    assert list(record_answers([problem], answers, records, proofs)) == []


def test_a_quick_proof_is_recorded_after_a_longer_search_without_one(tmp_path):
    answers, records = tmp_path / "answers", tmp_path / "records"
    answers.mkdir()
    tried = solving.Answer(
        {}, "stopped", RECORDS[ONE.id].best_pose.pose, 1.0, 0.0, 3.0, 3.0, "pose"
    )
    for found in (tried, replace(tried, cpu_s=2.0), replace(tried, status="optimal", cpu_s=1.0)):
        text = json.dumps(asdict(found))
        (answers / f"{ONE.id}.default.json").write_text(text, encoding="utf-8")
        list(record_answers([ONE], answers, records, tmp_path))
    made = read_record(ONE.id, records)
    assert [(solve.status, solve.cpu_s) for solve in made.solves] == [
        ("stopped", 3.0),
        ("optimal", 1.0),
    ]


def test_a_proof_that_is_not_stored_is_made_again(monkeypatch):
    large = find_problem("tiny-2d-line-4")
    assert not RECORDS[large.id].certificate.stored
    assert list(reprove([ONE], 60.0)) == []  # its proof is stored
    ((line, holds),) = reprove([large], 60.0)
    assert holds, line
    higher = RECORDS[large.id].model_copy(deep=True)
    object.__setattr__(higher.best_bound, "lower_bound", 1.001 * higher.objective)
    monkeypatch.setattr(solving, "read_record", lambda _: higher)
    ((line, holds),) = reprove([large], 1.0)
    assert not holds, line


def test_a_check_that_would_take_too_long_is_given_up(tmp_path, monkeypatch):
    monkeypatch.setattr(solving, "CHECK_S", 0.0)
    _, proof = solve(ONE, 60.0, tmp_path)
    assert (proof.status, proof.checked_bound) == ("optimal", None)
    assert proof.reason == "the check took too long"


def answer(pose, **more):
    return {"status": "optimal", "T_target_source": pose, "time_solve_s": 0.5, **more}


def test_verdicts_of_a_method():
    best = RECORDS[ONE.id].best_pose
    scope = {"certificate_scope": "similarity pose", "upper_bound": best.objective}
    far = np.array(best.pose) @ np.diag([-1.0, -1.0, 1.0])
    low = RECORDS[ONE.id].lower_bound
    verdicts = {
        name: judged(ONE, given)
        for name, given in {
            "proven": answer(best.pose, lower_bound=low, **scope),
            "solved": answer(best.pose),
            "missed": answer(far),
            "too small": answer(np.diag([0.1, 0.1, 1.0])),
            "wrong": answer(far, lower_bound=low, **scope),
            "too high": answer(best.pose, lower_bound=1.1 * best.objective, **scope),
            "loose": answer(best.pose, lower_bound=0.6 * best.objective, gap_tol=1.0, **scope),
            "rough": answer(far, lower_bound=low, gap_tol=1e3, **scope),
            "failed": {"status": "failed", "message": "no pose"},
        }.items()
    }
    found = {name: row["verdict"] for name, row in verdicts.items()}
    assert found == {
        **{name: name for name in verdicts}, "too high": "wrong", "too small": "missed",
        "loose": "solved", "rough": "missed",  # optimal within their own tolerance
    }  # fmt: skip
    text = summary("method", pd.DataFrame(list(verdicts.values())), 1.0)
    assert "solved: 0% in 0.1 s, 0% in 0.3 s, 33% in 1 s" in text


def test_a_method_receives_neither_pose_nor_pairs():
    instance = instance_of(ONE)
    assert instance.oracle_pairs is None
    assert instance.matches == {}
    assert instance.noise_bound > 0.0


def test_times_of_searches_without_a_proof_are_lower_limits():
    from reports.library.difficulty import Features, fit

    rng = np.random.default_rng(0)
    rows = pd.DataFrame({name: rng.uniform(1, 2, 300) for name in Features.__dataclass_fields__})
    rows["model"] = "rigid3d"
    overlap = (rows["overlap"] - rows["overlap"].mean()) / rows["overlap"].std()
    proof_s = 10.0 ** (rng.normal(0, 0.1, 300) - overlap)
    rows["is_limit"] = proof_s > 2.0
    rows["cpu_s"] = proof_s.clip(upper=2.0)
    model = fit(rows)
    assert 50 < model.n_open < 250
    assert model.factors["overlap"] == pytest.approx(0.1, rel=0.1)  # least squares: about 0.2
    assert "overlap" in model.sentence()


def test_an_entry_of_bibtex_has_author_and_year():
    from reports.library import page

    row = page._row(ONE, RECORDS[ONE.id])
    cite = page._details(row)["cite"]
    assert "author = {{The dcreg contributors}}" in cite
    assert re.search(r"year = \{20\d\d\}", cite)
    assert cite.count("{") == cite.count("}")


def test_points_of_a_recipe_are_drawn_where_they_are_available(tmp_path, monkeypatch):
    from reports.library import page

    problem, record = find_problem("bunny-60"), RECORDS["bunny-60@1"]
    monkeypatch.setenv("DCREG_DATA_CACHE", str(tmp_path))
    monkeypatch.delenv("DCREG_DATA_MIRROR", raising=False)
    monkeypatch.setattr(fetch, "_download", lambda *_: pytest.fail("a picture needs no download"))
    fresh = problem.model_copy()
    fresh.__dict__.pop("clouds", None)
    missing = page._details(page._row(fresh, record))
    assert missing["picture"] == ""
    clouds = np.zeros((60, 3)) + np.arange(60)[:, None], np.ones((60, 3))
    fresh.__dict__["clouds"] = clouds  # as if the mirror had the files
    row = page._row(fresh, record)
    found = page._details(row)
    assert "source" not in found
    assert found["picture"].count("<path") == row.thumbnail.count("<path") == 2
