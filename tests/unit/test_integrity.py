"""A changed byte of a result is noticed, wherever it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from workflows import records
from workflows.integrity import (
    DAMAGED,
    SUFFIXES,
    opened,
    sealed,
    sealed_file,
    set_aside_damaged,
)

ROW = {"run_id": "a", "status": "optimal", "pose": [[1.0, 0.0], [0.0, 1.0]], "message": "a b {}"}


def test_a_line_is_read_only_as_it_was_written() -> None:
    line = sealed(ROW)
    assert opened(line) == ROW
    for at in range(len(line)):
        assert opened(line[:at]) is None  # cut off
        assert opened(f"{line[:at]}#{line[at + 1 :]}") is None  # changed
    assert opened("") is None


def write(path: Path, suffix: str, rng: np.random.Generator) -> None:
    if suffix == ".npz":
        with sealed_file(path) as part, part.open("wb") as stream:
            np.savez_compressed(stream, points=rng.random((50, 3)))
    else:
        records.write(pd.DataFrame({"a": rng.random(50), "b": ["text"] * 50}), path)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_changed_file_is_set_aside(suffix: str, tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / "folder" / f"file{suffix}"
    path.parent.mkdir()
    for _ in range(2):  # the last checksum counts
        write(path, suffix, rng)
        content = path.read_bytes()
        assert set_aside_damaged(tmp_path) == []
    for at in [0, *rng.integers(len(content), size=20), len(content) - 1]:
        path.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
        assert set_aside_damaged(tmp_path) == [path], at
    for end in (0, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:end])
        assert set_aside_damaged(tmp_path) == [path], end
        assert not path.exists()
    assert path.with_name(path.name + DAMAGED).exists()


def test_a_file_without_a_checksum_is_set_aside(tmp_path: Path) -> None:
    path = tmp_path / "file.npz"
    path.touch()
    assert set_aside_damaged(tmp_path) == [path]
