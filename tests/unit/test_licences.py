"""The report of licences reads the metadata of packages."""

from __future__ import annotations

import csv
from email.message import Message
from importlib import metadata

import pytest

from workflows import licences

MIT = "License :: OSI Approved :: MIT License"
GPL = "License :: OSI Approved :: GNU General Public License (GPL)"


@pytest.mark.parametrize(
    ("expression", "field", "classifiers", "expected"),
    [
        ("MIT", "text", [GPL], "MIT"),
        ("", "BSD 3-Clause License\n\nCopyright …", [MIT], "MIT License"),
        ("", "\n=====\n  The Kiwi licence\n", ["Topic :: Text", "License :: OSI Approved"],
         "The Kiwi licence"),
        ("", "", [MIT, GPL], "MIT License / GNU General Public License (GPL)"),
        ("", "UNKNOWN", [], ""),
        ("", "", [], ""),
    ],
)  # fmt: skip
def test_the_licence_is_the_most_exact_statement(expression, field, classifiers, expected):
    assert licences.licence(expression, field, classifiers) == expected


def test_copyleft_unknown_and_absent_packages_are_listed(tmp_path, monkeypatch, capsys):
    packages = {
        "free": {"Version": "1", "License-Expression": "MIT"},
        "file-wise": {"Version": "2", "License-Expression": "MPL-2.0 AND MIT"},
        "silent": {"Version": "3"},
    }

    def facts(name):
        if name not in packages:
            raise metadata.PackageNotFoundError(name)
        message = Message()
        for key, value in packages[name].items():
            message[key] = value
        return message

    lock = tmp_path / "requirements.lock"
    lock.write_text(
        "Free==1 \\\n    --hash=sha256:00\nfile-wise==2\nsilent==3\n"
        "elsewhere==4 ; sys_platform != 'linux'\n"
    )
    monkeypatch.setattr(licences, "CHECKOUT", tmp_path)
    monkeypatch.setattr(licences.metadata, "metadata", facts)
    licences.main(tmp_path / "new" / "licences.csv")
    printed = capsys.readouterr().out
    for line in (
        "copyleft: 1: file-wise",
        "unknown: 1: silent",
        "not installed here: 1: elsewhere",
    ):
        assert line in printed
    with (tmp_path / "new" / "licences.csv").open() as file:
        found = list(csv.DictReader(file))
    assert [row["package"] for row in found] == ["elsewhere", "file-wise", "free", "silent"]
    assert found[2]["licence"] == "MIT"
