"""Instance masks that come with a recording."""

from __future__ import annotations

import cv2
import numpy as np

from semdb.errors import FrameError, UsageError
from semdb.perception.model_files import canonical_json
from semdb.types import Detection, ImageArray, InstanceMasks, ModelInfo

MIN_PIXELS = 64


class RecordedDetector:
    """One detection, with score 1, for every instance label that covers at least `MIN_PIXELS` pixels."""

    classes: tuple[str, ...] | None = None  # each recording has its own
    needs_masks = True

    def __init__(self) -> None:
        self.info = ModelInfo("detector", "recorded", "", canonical_json({"min_pixels": MIN_PIXELS}))

    def detect(self, image: ImageArray, instances: InstanceMasks | None) -> tuple[Detection, ...]:
        """The objects of `instances` in the order of their labels, each with its tight box.

        Raises UsageError when the image brings no masks, FrameError when the masks do not fit the image or a
        label has no class name.
        """
        if instances is None:
            raise UsageError(
                "this image brings no masks, so the detector 'recorded' has nothing to give: it is for images that "
                "lie in a recording with masks; for others the map must be ingested with SEMDB_DETECTOR=onnx:FILE"
            )
        labels = instances.labels
        if labels.shape != image.shape[:2]:
            raise FrameError(
                f"instance masks of {labels.shape[1]}x{labels.shape[0]} do not fit an image of "
                f"{image.shape[1]}x{image.shape[0]}: render or export both at one size"
            )
        found = []
        for label, count in zip(*np.unique(labels, return_counts=True), strict=True):
            if label == 0 or count < MIN_PIXELS:
                continue
            category = instances.categories.get(int(label))
            if not category:
                raise FrameError(
                    f"instance label {label} in the masks has no class name: add it to the list of classes"
                )
            mask = labels == label
            x, y, w, h = cv2.boundingRect(mask.view(np.uint8))
            box = np.array([x, y, x + w - 1, y + h - 1], dtype=np.float32)
            found.append(Detection(category, 1.0, box, mask))
        return tuple(found)
