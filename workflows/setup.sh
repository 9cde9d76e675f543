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

install() {
  workflows/install.sh "$venv" "$@"
}

# locked FILE NAME… : prints the entries of these packages in a lock file, with their hashes
locked() {
  awk -v names=" ${*:2} " '/^[^ ]/ { split($1, part, "=="); keep = index(names, " " part[1] " ") } keep' "$1"
}

echo "Setting up $venv (once; takes one to three minutes, mostly downloads and compilation) …"
[ -x "$venv/bin/python" ] || step "virtual environment" "$python" -m venv "$venv"
locked requirements-tools.lock uv >"$log/uv.lock"
step "uv, a faster installer" install --require-hashes --requirement "$log/uv.lock" ||
  echo "setup     without uv: pip installs"
locked requirements.lock setuptools numpy scipy numba llvmlite pykdtree lazy-loader >"$log/library.lock"
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
