#!/usr/bin/env bash
# Install Debian packages if possible; otherwise print the command and continue.
# usage: system_packages.sh WHAT-FOR PACKAGE…
set -u
purpose=$1
shift
missing=()
for package in "$@"; do
  dpkg-query -W -f '${Status}' "$package" 2>/dev/null | grep -q 'install ok installed' || missing+=("$package")
done
[ ${#missing[@]} -eq 0 ] && exit 0
command="apt-get install -y --no-install-recommends ${missing[*]}"
if command -v apt-get >/dev/null && [ "$(id -u)" -eq 0 ]; then
  echo "Installing system packages for $purpose: ${missing[*]}"
  export DEBIAN_FRONTEND=noninteractive
  { apt-get update -qq && $command -qq; } >/dev/null 2>&1 && exit 0
  echo "Could not install them; run manually: $command"
else
  echo "System packages for $purpose are missing; run as root: $command"
fi
exit 0
