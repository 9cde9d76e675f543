#!/usr/bin/env bash
# Fills the virtual environment VENV: locked packages, this library, compiled kernels, system packages.
# Independent steps run in parallel; every step prints its time.
# usage: setup.sh VENV PYTHON SYSTEM-PACKAGE…
set -eu
venv=$1
python=$2
shift 2
began=$SECONDS
log=$(mktemp -d)
trap 'rm -rf "$log"; kill $(jobs -p) 2>/dev/null || true' EXIT

# step WHAT COMMAND… : prints the output only if it fails
step() {
  local what=$1 since=$SECONDS
  shift
  if ! "$@" >"$log/${what// /-}" 2>&1; then
    cat "$log/${what// /-}" >&2
    echo "setup     failed: $what (the command was: $*)" >&2
    return 1
  fi
  printf 'setup     %-44s %4d s\n' "$what" $((SECONDS - since))
}

# Modules are compiled to bytecode at their first import: most are never imported. What is built from
# source is built with the setuptools of the lock file: otherwise pip would fetch one without a hash.
install() {
  "$venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-compile --no-deps \
    --no-build-isolation "$@"
}

# locked NAME… : prints the entries of these packages in the lock file, with their hashes
locked() {
  awk -v names=" $* " '/^[^ ]/ { split($1, part, "=="); keep = index(names, " " part[1] " ") } keep' \
    requirements.lock
}

echo "Setting up $venv (once; takes one to three minutes, mostly downloads and compilation) …"
[ -x "$venv/bin/python" ] || step "virtual environment" "$python" -m venv "$venv"
locked setuptools numpy scipy numba llvmlite pykdtree lazy-loader >"$log/library.lock"
step "what this library needs" install --require-hashes --requirement "$log/library.lock"
step "this library" install --editable .
step "compiled kernels" "$venv/bin/python" -m dcreg.driver.warm_up &
kernels=$!
workflows/system_packages.sh "open3d (its methods are 'unavailable' without it)" "$@" &
system=$!
step "packages of the benchmark" install --require-hashes --requirement requirements.lock
wait "$system"
wait "$kernels"
printf 'setup     %-44s %4d s\n' "total" $((SECONDS - began))
