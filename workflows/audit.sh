#!/usr/bin/env bash
# Looks up the known vulnerabilities of all locked packages. Exit code 1: there are some; 2: no check.
# usage: audit.sh PIP-AUDIT
set -u
code=0
for lock in requirements*.lock; do
  # strict: a package that the index does not know is an error, not a pass
  output=$("$1" --strict --progress-spinner off --disable-pip --requirement "$lock" 2>&1) && found=0 || found=1
  if [ $found -ne 0 ] && ! grep -q 'Found [0-9]* known vulnerabilit' <<<"$output"; then
    tail -n 1 <<<"$output" >&2
    echo "audit: $lock was not checked, which needs a network and the package index; see the line above" >&2
    exit 2
  fi
  printf '%s: %s\n' "$lock" "$output"
  code=$((code | found))
done
exit $code
