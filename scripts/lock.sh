#!/usr/bin/env bash
# Write $1: the exact version of everything that semdb[torch,worker,serve,dev] brings into an empty environment.
set -euo pipefail
lock=$1
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

"$(dirname "$0")/make-venv.sh" "$folder/venv"
"$folder/venv/bin/python" -m pip --disable-pip-version-check --quiet install --upgrade '.[torch,worker,serve,dev]'
{
  echo "# Written by 'make lock'. Exact versions of the base, the torch, the worker, the serve and the development extras;"
  echo "# torch and torchvision are PyPI's pair (docs/models.md says which pairs fit)."
  "$folder/venv/bin/python" -m pip --disable-pip-version-check list --format freeze --exclude semdb --exclude pip
} > "$folder/lock"
mv "$folder/lock" "$lock"
echo "$lock: $(grep -c == "$lock") packages"
