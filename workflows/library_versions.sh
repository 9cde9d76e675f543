#!/usr/bin/env bash
# Runs tests of the library, its command line and its figures with the lowest versions of their
# dependencies that pyproject.toml states, or with the newest ones that it admits.
# usage: library_versions.sh PYTHON lowest|newest
set -eu
python=$1 which=$2
venv=.venv-$which
"$python" -m venv "$venv"
needed=$("$venv/bin/python" - "$which" <<'END'
import sys, tomllib
with open("pyproject.toml", "rb") as file:
    project = tomllib.load(file)["project"]
needed = [*project["dependencies"], *project["optional-dependencies"].get("plot", [])]
pin = "==" if sys.argv[1] == "lowest" else ">="
print(*(requirement.replace(">=", pin) for requirement in needed))
END
)
echo "$which: $needed"
# shellcheck disable=SC2086
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check $needed \
  pytest pytest-timeout hypothesis pydantic pyyaml pooch clarabel \
  matplotlib seaborn
# packages of other times may warn of each other's deprecated names
NUMBA_CACHE_DIR=$venv/numba "$venv/bin/python" -m pytest -q -p no:cacheprovider -W ignore::DeprecationWarning \
  tests/golden/test_golden.py tests/unit/test_registration.py tests/unit/test_rigid.py \
  tests/unit/test_search.py tests/unit/test_certificate.py tests/unit/test_cli.py \
  tests/unit/test_plot.py tests/unit/test_public_api.py
