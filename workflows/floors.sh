#!/usr/bin/env bash
# Runs tests of the library, its command line and its figures with the lowest versions of their
# dependencies that pyproject.toml states.
# usage: floors.sh PYTHON
set -eu
python=$1
venv=.venv-floors
"$python" -m venv "$venv"
floors=$("$venv/bin/python" - <<'END'
import tomllib
with open("pyproject.toml", "rb") as file:
    project = tomllib.load(file)["project"]
needed = [*project["dependencies"], *project["optional-dependencies"].get("plot", [])]
print(*(requirement.replace(">=", "==") for requirement in needed))
END
)
echo "floors: $floors"
# shellcheck disable=SC2086
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check $floors \
  pytest pytest-timeout hypothesis pydantic pyyaml pooch  # the last three draw the shapes of the tests
NUMBA_CACHE_DIR=$venv/numba "$venv/bin/python" -m pytest -q -p no:cacheprovider \
  tests/golden/test_golden.py tests/unit/test_registration.py tests/unit/test_rigid.py \
  tests/unit/test_search.py tests/unit/test_certificate.py tests/unit/test_cli.py \
  tests/unit/test_plot.py tests/unit/test_public_api.py
