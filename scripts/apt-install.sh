#!/usr/bin/env bash
# Install Debian or Ubuntu packages: as root, or with sudo where it asks no password. Else: say what is missing, fail.
set -euo pipefail

if ! command -v apt-get >/dev/null; then
  echo "missing: $*; there is no apt-get here to install it with, so install its equivalent by hand" >&2
  exit 1
fi
if [ "$(id -u)" = 0 ]; then
  as_root=()
elif sudo -n true 2>/dev/null; then
  as_root=(sudo -n)
else
  echo "missing: $*; without root this cannot install it: sudo apt-get install $*" >&2
  exit 1
fi
echo "installing from the distribution: $*"
log=$(mktemp)
trap 'rm -f "$log"' EXIT
# an old or broken list may still do: whether the packages can be installed is what counts
"${as_root[@]}" apt-get update >"$log" 2>&1 || true
if ! "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install --yes --no-install-recommends "$@" >>"$log" 2>&1
then
  tail -n 20 "$log" >&2
  echo "could not install: $*" >&2
  exit 1
fi
