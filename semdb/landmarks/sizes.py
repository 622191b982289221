"""How large things of a class are: what the box of a thing says about its class.

Ranges are those of things that one can buy, and are wide. Furniture: Neufert, Architects' Data (seats, tables, beds,
kitchens). Books: ISO 216 and 217 from A6 to A4, some larger. Screens: diagonals of 19 to 65 inches at 16:9. Portable
devices: the smallest and largest that makers list. Luggage: IATA's cabin and hold sizes. What one cannot name a size
for (a bottle is a vase's size) is wide or not listed: then sizes say nothing.

A box is of what was seen. A thing may be larger than its box (half of it is hidden), but hardly smaller: what is larger
than things of a class are speaks against the class, and what is smaller does far less. What one carries is at most
so long, about twice what is typical, since a box may take in a bit of what is beside it: what is longer is none,
whatever the detector calls it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semdb.types import BoolArray, FloatArray

# metres: shortest and longest of the longest, the middle and the shortest side
Range = tuple[float, float]
Sides = tuple[Range, Range, Range]
CARRIED: dict[str, tuple[Sides, float]] = {  # and how long they are at most
    "apple": (((0.06, 0.10), (0.06, 0.10), (0.05, 0.10)), 0.3),
    "backpack": (((0.35, 0.65), (0.25, 0.45), (0.10, 0.35)), 1.5),
    "banana": (((0.12, 0.30), (0.05, 0.20), (0.03, 0.15)), 0.5),
    "baseball glove": (((0.20, 0.40), (0.15, 0.35), (0.06, 0.20)), 0.8),
    "book": (((0.14, 0.38), (0.10, 0.30), (0.005, 0.10)), 1.0),
    "bottle": (((0.14, 0.40), (0.05, 0.15), (0.05, 0.15)), 0.8),
    "bowl": (((0.10, 0.38), (0.10, 0.38), (0.04, 0.18)), 0.8),
    "broccoli": (((0.08, 0.25), (0.06, 0.22), (0.05, 0.20)), 0.5),
    "cake": (((0.08, 0.50), (0.06, 0.45), (0.03, 0.30)), 1.0),
    "carrot": (((0.08, 0.30), (0.02, 0.08), (0.02, 0.06)), 0.6),
    "cell phone": (((0.10, 0.18), (0.05, 0.09), (0.005, 0.03)), 0.3),
    "clock": (((0.06, 0.60), (0.06, 0.60), (0.02, 0.20)), 1.5),
    "cup": (((0.06, 0.16), (0.06, 0.14), (0.05, 0.12)), 0.4),
    "donut": (((0.06, 0.16), (0.06, 0.16), (0.02, 0.08)), 0.4),
    "fork": (((0.14, 0.24), (0.015, 0.04), (0.005, 0.03)), 0.5),
    "hair drier": (((0.14, 0.32), (0.10, 0.28), (0.06, 0.12)), 0.6),
    "handbag": (((0.18, 0.55), (0.12, 0.45), (0.04, 0.25)), 1.2),
    "hot dog": (((0.10, 0.30), (0.04, 0.12), (0.03, 0.10)), 0.5),
    "keyboard": (((0.24, 0.50), (0.10, 0.22), (0.01, 0.06)), 1.0),
    "knife": (((0.14, 0.36), (0.015, 0.06), (0.005, 0.03)), 0.7),
    "laptop": (((0.24, 0.45), (0.17, 0.34), (0.01, 0.32)), 1.0),
    "microwave": (((0.40, 0.65), (0.30, 0.52), (0.22, 0.42)), 1.2),
    "mouse": (((0.08, 0.14), (0.05, 0.08), (0.02, 0.06)), 0.3),
    "orange": (((0.06, 0.11), (0.06, 0.11), (0.05, 0.11)), 0.3),
    "pizza": (((0.14, 0.50), (0.10, 0.50), (0.01, 0.06)), 1.0),
    "remote": (((0.08, 0.26), (0.03, 0.07), (0.01, 0.04)), 0.5),
    "sandwich": (((0.08, 0.32), (0.06, 0.18), (0.02, 0.12)), 0.5),
    "scissors": (((0.10, 0.28), (0.05, 0.12), (0.005, 0.03)), 0.6),
    "spoon": (((0.11, 0.30), (0.02, 0.07), (0.005, 0.04)), 0.6),
    "sports ball": (((0.04, 0.35), (0.04, 0.28), (0.04, 0.26)), 0.8),
    "toaster": (((0.24, 0.46), (0.15, 0.32), (0.13, 0.26)), 1.0),
    "toothbrush": (((0.12, 0.27), (0.01, 0.05), (0.008, 0.05)), 0.5),
    "vase": (((0.08, 0.80), (0.05, 0.40), (0.05, 0.40)), 1.2),
    "wine glass": (((0.12, 0.27), (0.05, 0.12), (0.05, 0.12)), 0.5),
}
STANDING: dict[str, Sides] = {  # of these there may be larger ones, or several in a row
    "bed": ((1.40, 2.30), (0.70, 2.10), (0.30, 1.30)),
    "bench": ((0.80, 2.50), (0.35, 1.00), (0.25, 0.70)),
    "chair": ((0.70, 1.30), (0.40, 0.80), (0.38, 0.80)),
    "couch": ((1.20, 3.20), (0.70, 2.00), (0.60, 1.10)),
    "dining table": ((0.60, 3.00), (0.60, 1.40), (0.40, 1.10)),
    "oven": ((0.45, 0.95), (0.45, 0.95), (0.40, 0.75)),
    "potted plant": ((0.10, 2.20), (0.08, 1.50), (0.06, 1.50)),
    "refrigerator": ((0.80, 2.10), (0.50, 1.00), (0.45, 0.90)),
    "sink": ((0.30, 1.20), (0.25, 0.65), (0.08, 0.40)),
    "suitcase": ((0.45, 1.10), (0.30, 0.60), (0.16, 0.40)),  # a drawn handle included
    "teddy bear": ((0.12, 1.20), (0.10, 0.80), (0.06, 0.70)),
    "toilet": ((0.55, 0.90), (0.35, 0.80), (0.33, 0.50)),
    "tv": ((0.40, 1.50), (0.24, 0.95), (0.02, 0.32)),
    "umbrella": ((0.20, 1.30), (0.04, 1.30), (0.03, 1.00)),
}
TYPICAL = {**{name: sides for name, (sides, _) in CARRIED.items()}, **STANDING}
LARGER, SMALLER = 0.15, 0.6  # deviations, of the logarithm of a side: beyond the longest, and below the shortest
MOST = 6.0  # a box speaks against a class at most so much, as log odds


@dataclass(frozen=True, slots=True, eq=False)
class Sizes:
    """What is known of the sizes of classes."""

    sides: FloatArray  # [classes, 3, 2] metres, the longest side first, lowest and highest; NaN where nobody knows
    longest: FloatArray  # [classes] metres: a thing with a longer side is of another class; infinite where none is

    def fits(self, boxes: FloatArray) -> FloatArray:
        """Logarithms ``[n, classes]`` of how well boxes of sides ``[n, 3]`` (metres) fit each class: 0 to -`MOST`.

        NaN of a class of which no size is known.
        """
        box = np.log(np.maximum(np.sort(boxes, axis=1)[:, None, ::-1], 1e-3))
        low, high = np.log(self.sides[..., 0]), np.log(self.sides[..., 1])
        over, under = np.maximum(box - high, 0) / LARGER, np.maximum(low - box, 0) / SMALLER
        return np.asarray(-np.minimum(0.5 * (over**2 + under**2).sum(axis=2), MOST), np.float64)

    def too_large(self, boxes: FloatArray) -> BoolArray:
        """Which classes ``[n, classes]`` things with boxes of sides ``[n, 3]`` (metres) are too large for."""
        return np.asarray(boxes.max(axis=1, initial=0.0)[:, None] > self.longest, np.bool_)


def sizes_of(names: Sequence[str]) -> Sizes:
    """What is known of classes, by their `names`."""
    unknown = ((np.nan, np.nan),) * 3
    sides = np.array([TYPICAL.get(name, unknown) for name in names], np.float64).reshape(-1, 3, 2)
    longest = [CARRIED[name][1] if name in CARRIED else np.inf for name in names]
    return Sizes(sides, np.array(longest, np.float64))


def unknown_sizes(classes: int) -> Sizes:
    """Nothing is known of so many classes."""
    return sizes_of([""] * classes)
