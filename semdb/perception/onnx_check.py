"""How alike a network in torch and its ONNX file are, on real images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from semdb.errors import ModelError
from semdb.perception.detectors import load_detector
from semdb.perception.encoders import load_encoder
from semdb.perception.onnx_export import Exported
from semdb.perception.protocols import Detector, Encoder
from semdb.settings import Settings
from semdb.types import BoolArray, Detection, ImageArray

Progress = Callable[[int, int], None]


def check_export(
    exported: Exported, spec: str, images: Sequence[ImageArray], settings: Settings, progress: Progress | None = None
) -> str:
    """A line that says how much `exported` and the network of `spec` differ on `images`, both on the CPU.

    Raises ModelError when that is more than rounding.
    """
    cpu = settings.model_copy(update={"device": "cpu"})
    onnx = f"onnx:{exported.path.absolute()}"
    if exported.role == "encoder":
        found = compare_encoders(load_encoder(spec, cpu), load_encoder(onnx, cpu), images, progress)
        line = f"{len(images)} images: embeddings differ by at most {found:.1e}"
        equal = found <= EQUAL_EMBEDDINGS
    else:
        pair = load_detector(spec, cpu), load_detector(onnx, cpu)
        difference = compare_detectors(*pair, images, cpu.score_threshold, progress)
        line, equal = str(difference), difference.equal
    if not equal:
        raise ModelError(f"{exported.path} is not what {spec} is: {line}")
    return line


@dataclass(frozen=True, slots=True)
class DetectorDifference:
    """How two detectors differ on some images. `unpaired`: objects of one that the other does not have."""

    images: int
    objects: int
    unpaired: int
    box_px: float
    score: float
    mask_iou: float

    def __str__(self) -> str:
        return (
            f"{self.images} images, {self.objects} objects: {self.unpaired} without counterpart, boxes differ by at "
            f"most {self.box_px:.1e} pixels, scores by {self.score:.1e}, least mask IoU {self.mask_iou:.4f}"
        )

    @property
    def equal(self) -> bool:
        """Boxes within 0.5 pixels, scores within 0.001, mask IoU above 0.99, the same objects."""
        return self.unpaired == 0 and self.box_px <= 0.5 and self.score <= 1e-3 and self.mask_iou > 0.99


EQUAL_EMBEDDINGS = 1e-4
_NEAR_THRESHOLD = 1e-3  # an object this close to the score threshold may be on either side of it


def compare_detectors(
    one: Detector,
    other: Detector,
    images: Sequence[ImageArray],
    threshold: float,
    progress: Progress | None = None,
) -> DetectorDifference:
    """Pairs the detections of both on each image by class and mask; `threshold` is the score below which none are."""
    objects = unpaired = 0
    box = score = 0.0
    iou = 1.0
    for done, image in enumerate(images, start=1):
        left, right = ([d for d in detector.detect(image, None) if not d.weak] for detector in (one, other))
        objects += len(left)
        for detection in left:
            same = [d for d in right if d.category == detection.category]
            best = max(same, key=lambda d, mask=detection.mask: mask_iou(mask, d.mask), default=None)  # type: ignore[misc]
            if best is None or mask_iou(detection.mask, best.mask) < 0.5:
                unpaired += _counts(detection, threshold)
                continue
            right.remove(best)
            box = max(box, float(np.abs(detection.box - best.box).max()))
            score = max(score, abs(detection.score - best.score))
            iou = min(iou, mask_iou(detection.mask, best.mask))
        unpaired += sum(_counts(detection, threshold) for detection in right)
        if progress is not None:
            progress(done, len(images))
    return DetectorDifference(len(images), objects, unpaired, box, score, iou)


def _counts(detection: Detection, threshold: float) -> bool:
    return detection.score > threshold + _NEAR_THRESHOLD


def mask_iou(a: BoolArray, b: BoolArray) -> float:
    """Intersection over union of two masks, 1 for two empty ones."""
    union = int(np.count_nonzero(a | b))
    return int(np.count_nonzero(a & b)) / union if union else 1.0


def compare_encoders(
    one: Encoder, other: Encoder, images: Sequence[ImageArray], progress: Progress | None = None
) -> float:
    """The largest difference of any component of the vectors of `images`."""
    largest = 0.0
    for done, image in enumerate(images, start=1):
        largest = max(largest, float(np.abs(one.encode(image) - other.encode(image)).max()))
        if progress is not None:
            progress(done, len(images))
    return largest
