"""Masks as a real detector gives them: objects that are missed in a frame, and objects that go by another name."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

Labels = npt.NDArray[np.uint16]

MISNAMED = 1000  # added to the label of an instance where it goes by the other name

# What detectors trained on COCO take each other for.
TAKEN_FOR = {
    "apple": "orange",
    "backpack": "suitcase",
    "bed": "couch",
    "bench": "chair",
    "book": "cell phone",
    "bottle": "vase",
    "bowl": "cup",
    "cell phone": "remote",
    "chair": "bench",
    "couch": "bed",
    "cup": "bowl",
    "dining table": "bench",
    "keyboard": "laptop",
    "laptop": "tv",
    "microwave": "oven",
    "orange": "apple",
    "oven": "microwave",
    "refrigerator": "oven",
    "remote": "cell phone",
    "sports ball": "orange",
    "suitcase": "backpack",
    "toaster": "microwave",
    "tv": "laptop",
    "vase": "bottle",
    "wine glass": "vase",
}


def with_misnamed(classes: Mapping[int, str]) -> dict[int, str]:
    """`classes` by label, and those of the labels of instances that go by another name."""
    others = {label + MISNAMED: TAKEN_FOR[name] for label, name in classes.items() if name in TAKEN_FOR}
    return {**classes, **others}


def make_mistakes(
    labels: Labels, classes: Mapping[int, str], missed: float, confused: float, seed: int, frame: int
) -> Labels:
    """`labels` ``[H, W]`` of one frame without the share `missed` of instances, the share `confused` misnamed.

    Which ones depends on seed, frame and instance alone.
    """
    table = np.arange(max([0, *classes]) + 1, dtype=np.uint16)
    for label, name in classes.items():
        chance = float(np.random.default_rng([seed, 7, frame, label]).random())
        if chance < missed:
            table[label] = 0
        elif chance < missed + confused and name in TAKEN_FOR:
            table[label] = label + MISNAMED
    return table[labels]
