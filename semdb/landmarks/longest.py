"""How large things are at most: what is larger is none, whatever the detector calls it.

Only upper bounds: of a thing that is cut, or behind another one, the box is too small. They are wide, since a box may
take in a bit of what is beside it: two to three times what is usual. Furniture, animals and vehicles, and classes of
detectors of one's own, have none.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from semdb.types import FloatArray

LONGEST_M = {  # the longest side of its box, of classes of COCO
    "apple": 0.3,
    "backpack": 1.5,
    "banana": 0.5,
    "baseball glove": 0.8,
    "book": 1.0,
    "bottle": 0.8,
    "bowl": 0.8,
    "broccoli": 0.5,
    "cake": 1.0,
    "carrot": 0.6,
    "cell phone": 0.3,
    "clock": 1.5,
    "cup": 0.4,
    "donut": 0.4,
    "fork": 0.5,
    "hair drier": 0.6,
    "handbag": 1.2,
    "hot dog": 0.5,
    "keyboard": 1.0,
    "knife": 0.7,
    "laptop": 1.0,
    "microwave": 1.2,
    "mouse": 0.3,
    "orange": 0.3,
    "pizza": 1.0,
    "remote": 0.5,
    "sandwich": 0.5,
    "scissors": 0.6,
    "spoon": 0.6,
    "sports ball": 0.8,
    "toaster": 1.0,
    "toothbrush": 0.5,
    "vase": 1.2,
    "wine glass": 0.5,
}


def longest_of(classes: Sequence[str]) -> FloatArray:
    """The bounds of `classes`, metres ``[n]``, infinite where there is none."""
    return np.array([LONGEST_M.get(name, np.inf) for name in classes], np.float64)
