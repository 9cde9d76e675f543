"""Files of certificates: written completely, read as plain arrays, refused if damaged."""

import dataclasses
import pickle
from pathlib import Path

import numpy as np
import pytest

from dcreg.certificate import Certificate, CertificateError, format, read, write
from dcreg.certificate.verification import verify
from tests.certificates import DIM, made_case


@pytest.fixture(scope="module", params=DIM)
def case(request):
    return made_case(request.param)


def test_file_contains_what_was_written_as_plain_arrays(tmp_path, case):
    certificate = case[0]
    write(tmp_path / "a.npz", certificate)
    again = read(tmp_path / "a.npz")
    for entry in dataclasses.fields(Certificate):
        np.testing.assert_array_equal(
            getattr(again, entry.name), getattr(certificate, entry.name), err_msg=entry.name
        )
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:
        assert all(file[name].dtype != object for name in file.files)
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]


def test_failed_write_leaves_the_old_file(tmp_path, monkeypatch, case):
    path = tmp_path / "certificate.npz"
    write(path, case[0])
    before = path.read_bytes()

    def full_disk(file, **_):
        file.write(b"half")
        raise OSError("no space left on device")

    monkeypatch.setattr(format.np, "savez_compressed", full_disk)
    with pytest.raises(OSError, match="no space left"):
        write(path, case[0])
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["certificate.npz"]


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.99])
def test_truncated_file_is_refused(tmp_path, case, share):
    certificate, source, target = case
    path = tmp_path / "certificate.npz"
    write(path, certificate)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    report = verify(path, source, target)
    assert not report.accepted
    assert "not a readable certificate" in report.reason


def test_flipped_bytes_never_change_what_is_accepted(tmp_path, case, rng):
    certificate = case[0]
    path = tmp_path / "certificate.npz"
    write(path, certificate)
    content = path.read_bytes()
    n_refused = 0
    for at in rng.integers(len(content), size=150):
        broken = bytearray(content)
        broken[at] ^= 0x55
        path.write_bytes(broken)
        try:
            kept = read(path)  # a zip holds bytes without meaning, such as time stamps
        except CertificateError:
            n_refused += 1
        else:
            np.testing.assert_array_equal(kept.leaf_bounds, certificate.leaf_bounds)
            np.testing.assert_array_equal(kept.theta, certificate.theta)
    assert n_refused > 100


def test_changed_entry_without_a_new_checksum_is_refused(tmp_path, case):
    certificate, source, target = case
    path = tmp_path / "certificate.npz"
    write(path, certificate)
    with np.load(path) as file:
        arrays = dict(file)
    for name in ("leaf_bounds", "theta", "n_inliers", "source_digest"):
        changed = arrays[name].copy()
        changed.flat[0] = changed.flat[0] + (1 if changed.dtype.kind != "U" else "x")
        if changed.dtype.kind == "U":
            changed = np.array(str(arrays[name])[::-1])
        np.savez(path, **(arrays | {name: changed}))
        assert "checksum" in verify(path, source, target).reason
    np.savez(path, **{name: array for name, array in arrays.items() if name != "leaf_bounds"})
    assert "wrong entries: ['leaf_bounds']" in verify(path, source, target).reason
    np.savez(path, **(arrays | {"format_version": np.array(99)}))
    assert "format version" in verify(path, source, target).reason


class Payload:
    """An object that creates a file when it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return Path.touch, (self.mark,)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("model", np.array(["similarity2d"]), "model: type"),
        ("source_digest", np.array(7), "source_digest: type int64, expected str"),
        ("theta", np.ones(4, dtype=complex), "theta: type complex128, expected float64"),
        ("n_inliers", np.array(3.0), "n_inliers: type float64, expected int64"),
        ("upper_bound", np.array(1e300), "upper_bound: not a finite number"),
    ],
)
def test_entries_of_another_type_or_size_are_refused(tmp_path, case, name, value, words):
    """With the right checksum: such entries would otherwise fail in a later check."""
    path = tmp_path / "certificate.npz"
    write(path, case[0])
    with np.load(path) as file:
        arrays = {**dict(file), name: value}
    del arrays["checksum"]
    np.savez(path, **arrays, checksum=format._checksum(arrays))
    with pytest.raises(CertificateError, match=words):
        read(path)


def test_pickles_are_refused_and_not_run(tmp_path, case):
    certificate, source, target = case
    mark, path = tmp_path / "mark", tmp_path / "certificate.npz"
    write(path, certificate)
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **(arrays | {"theta": np.array([Payload(mark)], dtype=object)}))
    assert "not a readable certificate" in verify(path, source, target).reason
    path.write_bytes(pickle.dumps(Payload(mark)))
    assert "not a readable certificate" in verify(path, source, target).reason
    assert not mark.exists()


def test_other_files_are_refused(tmp_path, case):
    _, source, target = case
    path = tmp_path / "other.npz"
    assert "no such file" in verify(path, source, target).reason
    np.savez(path, x=np.zeros(3))
    assert "not a dcreg leaf cover" in verify(path, source, target).reason
    path.write_text("{}")
    assert "not a readable certificate" in verify(path, source, target).reason
    np.save(tmp_path / "one.npy", np.zeros(3))
    report = verify(tmp_path / "one.npy", source, target)
    assert "not a readable certificate" in report.reason
    assert not report.is_certificate
    assert "allow_pickle" not in report.reason
