#!/usr/bin/env bash
# Installs packages, exactly those that are named, into the virtual environment VENV, with uv or with pip.
# usage: install.sh VENV ARGUMENT-OF-PIP…
set -eu
venv=$1
shift
# Both leave the modules uncompiled: most are never imported. What is built from source is built with the
# setuptools of VENV, where it has any: otherwise one without a hash would be fetched.
exactly=(--quiet --no-deps)
if "$venv/bin/python" -c 'import setuptools' 2>/dev/null; then exactly+=(--no-build-isolation); fi

# uv needs a tenth of the time, but does not read pip's settings: where they replace the index, pip installs.
if [ -x "$venv/bin/uv" ] && ! "$venv/bin/python" -m pip config list | grep -Eq '[.](index-url|no-index)='; then
  "$venv/bin/uv" pip install --python "$venv/bin/python" "${exactly[@]}" "$@" && exit
  echo "uv cannot install this; pip tries." >&2
fi
exec "$venv/bin/python" -m pip install --disable-pip-version-check --no-compile "${exactly[@]}" "$@"
