#!/usr/bin/env bash
# Make the virtual environment $1 with the first Python that semdb supports. PYTHON=... chooses another one.
set -euo pipefail
venv=$1

supported() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; }

python=""
# 3.11 first: the lock file is made with it
for candidate in ${PYTHON:-python3.11 python3.12 python3.13 python3 python3.14}; do
  if supported "$candidate"; then python=$candidate; break; fi
done
if [ -z "$python" ]; then
  echo "semdb needs Python 3.11 or newer and found none (looked for ${PYTHON:-python3.11 to python3.14 and python3})." \
       "Install one, or name it: make PYTHON=/path/to/python3.11 ..." >&2
  exit 1
fi

if ! "$python" -c 'import venv, ensurepip' >/dev/null 2>&1; then
  package=$("$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')
  echo "$python has no venv module; Debian and Ubuntu keep it in the package $package" >&2
  "$(dirname "$0")/apt-install.sh" "$package"
fi
echo "making $venv with $("$python" --version)"
"$python" -m venv "$venv"
