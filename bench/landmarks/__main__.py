"""Landmarks of rendered rooms against exact instance truth.

``python -m bench.landmarks [--rooms N] [--first SEED] [--keyframes N] [--json FILE]``. Each room is a map of its own.
Masks are exact, or 30 % of the objects are missed, 15 % misnamed, 30 % of the masks cut, with a pose noise of 1 cm and
0.5 degrees (root mean square); both with exact depth and with that of a noisy sensor. A thing counts when the detector
found it in at least three keyframes; its box is that of the surface that at least two keyframes see, along its own
axes, with sides of 3 cm at least. Needs no model file. Seeds below 403 were tuned on; the default is judged on others.
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict
from pathlib import Path

from bench.landmarks.rooms import (
    EXACT,
    NOISY,
    SPOILED,
    SPOILED_NOISY,
    class_numbers,
    render_room,
    rooms_parser,
    seen_keyframes,
    true_things,
)
from bench.landmarks.scores import HEADER, Score, relation_counts, score, summed
from semdb.landmarks.build import find_landmarks
from semdb.landmarks.sizes import sizes_of

SETTINGS = {"exact": EXACT, "mistakes": SPOILED, "exact, noisy depth": NOISY, "mistakes, noisy depth": SPOILED_NOISY}


def main() -> None:
    parser = rooms_parser(__doc__)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    scores: dict[str, list[Score]] = {name: [] for name in SETTINGS}
    related: dict[str, dict[str, tuple[int, int, int]]] = {name: {} for name in SETTINGS}
    seconds = 0.0
    for seed in range(given.first, given.first + given.rooms):
        room = render_room(seed, given.keyframes, given.width)
        numbers, things = class_numbers([room]), true_things(room)
        for name, mistakes in SETTINGS.items():
            keyframes, labels = seen_keyframes(room, numbers, mistakes)
            start = time.perf_counter()
            found = find_landmarks(keyframes, len(numbers), sizes=sizes_of(list(numbers)))
            seconds += time.perf_counter() - start
            scores[name].append(score(found.landmarks, labels, things, list(numbers)))
            for kind, counts in relation_counts(found.landmarks, labels, things, list(numbers)).items():
                before = related[name].get(kind, (0, 0, 0))
                related[name][kind] = (before[0] + counts[0], before[1] + counts[1], before[2] + counts[2])
        print(f"room {seed}: {scores['exact'][-1].things} things", flush=True)
    print(f"{given.rooms} rooms of {given.keyframes} keyframes, {seconds / given.rooms / len(SETTINGS):.2f} s each")
    print(f"{'':24}{HEADER}")
    for name, of_rooms in scores.items():
        print(f"{name:24}{summed(of_rooms).line}")
    print(f"{'':24}relations, precision and recall by kind")
    for name, by_kind in related.items():
        parts = [f"{kind} {r / max(r + w, 1):.3f} {r / max(r + m, 1):.3f} ({r})" for kind, (r, w, m) in by_kind.items()]
        print(f"{name:24}{', '.join(parts)}")
    if given.json is not None:
        values = {name: [asdict(one) for one in of_rooms] for name, of_rooms in scores.items()}
        given.json.write_text(json.dumps(values, indent=2) + "\n")


if __name__ == "__main__":
    main()
