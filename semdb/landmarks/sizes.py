"""How large things of a class are: what the box of a thing says about its class.

Ranges are those of things that one can buy, and are wide. Furniture: Neufert, Architects' Data (seats, tables, beds,
kitchens). Books: ISO 216 and 217 from A6 to A4, some larger. Screens: diagonals of 19 to 65 inches at 16:9. Portable
devices: the smallest and largest that makers list. Luggage: IATA's cabin and hold sizes. What one cannot name a size
for (a bottle is a vase's size) is wide or not listed: then sizes say nothing.

A box is of what was seen. A thing may be larger than its box (half of it is hidden), but hardly smaller: what is larger
than things of a class are speaks against the class, and what is smaller does far less.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from semdb.types import FloatArray

# metres: shortest and longest of the longest, the middle and the shortest side
Range = tuple[float, float]
TYPICAL: dict[str, tuple[Range, Range, Range]] = {
    "apple": ((0.06, 0.10), (0.06, 0.10), (0.05, 0.10)),
    "backpack": ((0.35, 0.65), (0.25, 0.45), (0.10, 0.35)),
    "banana": ((0.12, 0.30), (0.05, 0.20), (0.03, 0.15)),
    "bed": ((1.40, 2.30), (0.70, 2.10), (0.30, 1.30)),
    "bench": ((0.80, 2.50), (0.35, 1.00), (0.25, 0.70)),
    "book": ((0.14, 0.38), (0.10, 0.30), (0.005, 0.10)),
    "bottle": ((0.14, 0.40), (0.05, 0.15), (0.05, 0.15)),
    "bowl": ((0.10, 0.38), (0.10, 0.38), (0.04, 0.18)),
    "cell phone": ((0.10, 0.18), (0.05, 0.09), (0.005, 0.03)),
    "chair": ((0.70, 1.30), (0.40, 0.80), (0.38, 0.80)),
    "couch": ((1.20, 3.20), (0.70, 2.00), (0.60, 1.10)),
    "cup": ((0.06, 0.16), (0.06, 0.14), (0.05, 0.12)),
    "dining table": ((0.60, 3.00), (0.60, 1.40), (0.40, 1.10)),
    "fork": ((0.14, 0.24), (0.015, 0.04), (0.005, 0.03)),
    "keyboard": ((0.24, 0.50), (0.10, 0.22), (0.01, 0.06)),
    "knife": ((0.14, 0.36), (0.015, 0.06), (0.005, 0.03)),
    "laptop": ((0.24, 0.45), (0.17, 0.34), (0.01, 0.32)),
    "microwave": ((0.40, 0.65), (0.30, 0.52), (0.22, 0.42)),
    "mouse": ((0.08, 0.14), (0.05, 0.08), (0.02, 0.06)),
    "orange": ((0.06, 0.11), (0.06, 0.11), (0.05, 0.11)),
    "oven": ((0.45, 0.95), (0.45, 0.95), (0.40, 0.75)),
    "refrigerator": ((0.80, 2.10), (0.50, 1.00), (0.45, 0.90)),
    "remote": ((0.08, 0.26), (0.03, 0.07), (0.01, 0.04)),
    "scissors": ((0.10, 0.28), (0.05, 0.12), (0.005, 0.03)),
    "sink": ((0.30, 1.20), (0.25, 0.65), (0.08, 0.40)),
    "spoon": ((0.11, 0.30), (0.02, 0.07), (0.005, 0.04)),
    "suitcase": ((0.45, 1.10), (0.30, 0.60), (0.16, 0.40)),  # a drawn handle included
    "toaster": ((0.24, 0.46), (0.15, 0.32), (0.13, 0.26)),
    "toilet": ((0.55, 0.90), (0.35, 0.80), (0.33, 0.50)),
    "tv": ((0.40, 1.50), (0.24, 0.95), (0.02, 0.32)),
    "wine glass": ((0.12, 0.27), (0.05, 0.12), (0.05, 0.12)),
}
LARGER, SMALLER = 0.1, 0.6  # deviations, of the logarithm of a side: beyond the longest, and below the shortest
MOST = 3.0  # a box speaks against a class at most so much, as log odds
SIZES = tuple[float, ...]


def size_likelihood(size: FloatArray, names: Sequence[str]) -> FloatArray:
    """Logarithms ``[classes]`` of how well a box of sides `size` ``[3]`` (metres) fits each class: 0 to -`MOST`."""
    sides = np.log(np.maximum(np.sort(size)[::-1], 1e-3))
    found = np.zeros(len(names))
    for number, name in enumerate(names):
        if name in TYPICAL:
            low, high = np.log(np.array(TYPICAL[name])).T
            over, under = np.maximum(sides - high, 0) / LARGER, np.maximum(low - sides, 0) / SMALLER
            found[number] = -min(0.5 * float((over**2 + under**2).sum()), MOST)
    return found
