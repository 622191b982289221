#!/usr/bin/env bash
# The demonstration: a rendered room becomes a database, images of it become camera poses. $1 is the semdb command.
# Everything goes to demo-output/, which is made anew.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
semdb=$1
python=$(dirname "$semdb")/python
out=demo-output
frames=80 keyframes=16 queries=24 shown=4

# the demonstration is the same whatever is set for other databases and models
for name in $(compgen -e SEMDB_ || true); do unset "$name"; done
rm -rf "$out"
mkdir -p "$out"
export SEMDB_DATABASE_URL="sqlite:///$out/semdb.sqlite3"

step() {
  echo
  printf '$ semdb'
  for word in "$@"; do case $word in *[[:space:]]*) printf ' "%s"' "$word" ;; *) printf ' %s' "$word" ;; esac; done
  echo
  "$semdb" "$@"
}

echo "database: $SEMDB_DATABASE_URL"
step synth "$out/room" --frames "$frames"
step recording "$out/room"
step ingest "$out/room" --map room --keyframes "$keyframes"
step refine --map room --step landmarks
step status

step sql "SELECT category, COUNT(*) AS seen, COUNT(DISTINCT keyframe_id) AS keyframes, ROUND(AVG(keypoints)) AS keypoints
FROM keyframe_objects GROUP BY category ORDER BY seen DESC LIMIT 8"

# images that are no keyframes, evenly spaced
mapfile -t stored < <("$semdb" sql "SELECT frame_index FROM keyframes" --format csv | tail -n +2)
mapfile -t images < <(ls "$out"/room/rgb/*.png | "$python" -c '
import sys
stored = {int(index) for index in sys.argv[2:]}
others = [line.rstrip("\n") for index, line in enumerate(sys.stdin) if index not in stored]
count = int(sys.argv[1])
print(*(others[(2 * i + 1) * len(others) // (2 * count)] for i in range(count)), sep="\n")' "$shown" "${stored[@]}")
step localize "${images[@]}" --map room --like "$out/room" --plot "$out/localize"
mkdir "$out/photos"
cp "${images[@]}" "$out/photos" # to drop on the page of make serve

step evaluate "$out/room" --keyframes "$keyframes" --max-queries "$queries" \
  --json "$out/evaluation.json" --report "$out/report"

echo
echo "pictures:"
find "$out" -name '*.png' -not -path "$out/room/*" -not -path "$out/photos/*" | sort | sed 's/^/  /'
echo "photos to drop on the page of make serve: $out/photos"
"$python" - "$out/evaluation.json" <<'PYTHON'
import json
import sys

with open(sys.argv[1]) as file:
    result = json.load(file)
print(f"localized {result['localized']} of {result['queries']}")
PYTHON
