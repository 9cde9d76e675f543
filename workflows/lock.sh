#!/usr/bin/env bash
# Remakes the lock files: each package keeps its version and gets the hashes of all files that the package
# index has of it, for every platform. To add or upgrade a package, edit its version first.
# usage: lock.sh UV
set -eu
uv=$1
pins=$(mktemp)
trap 'rm -f "$pins"' EXIT
for lock in requirements*.lock; do
  grep -E '^[A-Za-z]' "$lock" | sed 's/ *\\$//' >"$pins"
  "$uv" pip compile --quiet --no-deps --universal --python-version 3.11.5 --generate-hashes \
    --no-annotate --no-header --no-emit-index-url --output-file "$lock.part" "$pins"
  mv "$lock.part" "$lock"
  echo "$lock: $(grep -c '^[A-Za-z]' "$lock") packages, $(grep -c -e '--hash' "$lock") hashes"
done
