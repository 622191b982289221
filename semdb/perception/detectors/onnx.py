"""Mask R-CNN in ONNX Runtime."""

from __future__ import annotations

import json

import cv2
import numpy as np
import numpy.typing as npt

from semdb.errors import ModelError
from semdb.perception.detectors.coco import COCO_91, NO_OBJECT
from semdb.perception.model_files import OnnxModel, canonical_json, resolve_onnx
from semdb.settings import Settings
from semdb.storable_names import check_class_names
from semdb.types import BoolArray, Detection, Float32Array, ImageArray, InstanceMasks, ModelInfo

MASK_THRESHOLD = 0.5
WEAK_THRESHOLD = 0.05  # from here on what the network saw is evidence of a class; exports give no less
NO_MASK: BoolArray = np.zeros((0, 0), dtype=np.bool_)
_OUTPUTS = ("boxes", "labels", "scores", "masks")


class OnnxDetector:
    """A Mask R-CNN export: ``[1, 3, H, W]`` RGB 0..1 to boxes, labels, scores and masks in input pixels.

    Class names come from the file's ``metadata_props["classes"]`` (a JSON list by label), otherwise they are
    COCO's. Detections below `score_threshold` are weak; those below 0.05, with an empty mask or with a label that
    stands for nothing are dropped.
    """

    def __init__(self, spec: str, settings: Settings) -> None:
        path = resolve_onnx(spec, settings)
        self._model = OnnxModel(path, settings.threads, _OUTPUTS, settings.device)
        self.classes = _class_names(self._model)
        self._score_threshold = settings.score_threshold
        config = {
            "mask_threshold": MASK_THRESHOLD,
            "score_threshold": settings.score_threshold,
            "weak_threshold": WEAK_THRESHOLD,
        }
        self.info = ModelInfo("detector", f"onnx:{path.name}", self._model.sha256, canonical_json(config))

    def detect(self, image: ImageArray, instances: InstanceMasks | None = None) -> tuple[Detection, ...]:
        """Objects of an RGB `image` ``[H, W, 3]`` by descending score; `instances` are not used.

        Raises ModelError when the network fails or its outputs do not fit together.
        """
        height, width = image.shape[:2]
        boxes, labels, scores, masks = self._model.run(image_to_batch(image))
        self._check(boxes, labels, scores, masks, height, width)
        order = np.argsort(-scores, kind="stable")
        limits = np.array([width - 1, height - 1, width - 1, height - 1], dtype=np.float32)
        found = []
        for k in order[scores[order] >= min(WEAK_THRESHOLD, self._score_threshold)]:
            category, weak = self._category(int(labels[k])), bool(scores[k] < self._score_threshold)
            mask = NO_MASK if weak else masks[k, 0] >= MASK_THRESHOLD
            if category in NO_OBJECT or not (weak or mask.any()):
                continue
            box: Float32Array = np.clip(boxes[k], 0, limits).astype(np.float32)
            found.append(Detection(category, float(scores[k]), box, mask, weak))
        return tuple(found)

    def _category(self, label: int) -> str:
        if not 0 <= label < len(self.classes):
            raise ModelError(
                f"{self._model.path} gave label {label} but has {len(self.classes)} class names: "
                'set metadata_props["classes"] in the file to a JSON list with a name for every label'
            )
        return self.classes[label]

    def _check(
        self,
        boxes: npt.NDArray[np.generic],
        labels: npt.NDArray[np.generic],
        scores: npt.NDArray[np.generic],
        masks: npt.NDArray[np.generic],
        height: int,
        width: int,
    ) -> None:
        n = scores.shape[0] if scores.ndim == 1 else -1
        if boxes.shape != (n, 4) or labels.shape != (n,) or masks.shape != (n, 1, height, width):
            raise ModelError(
                f"{self._model.path} is no Mask R-CNN export that semdb reads: for an image of {width}x{height} "
                f"boxes are {boxes.shape}, labels {labels.shape}, scores {scores.shape}, masks {masks.shape}; "
                "wanted are [N, 4], [N], [N] and [N, 1, H, W]"
            )
        if not np.isfinite(scores).all() or not np.isfinite(boxes).all():
            raise ModelError(f"{self._model.path} gave scores or boxes that are not finite: the file is damaged")


def image_to_batch(image: ImageArray) -> Float32Array:
    """`image` ``[H, W, 3]`` as float32 ``[1, 3, H, W]`` from 0 to 1."""
    batch = np.empty((1, 3, *image.shape[:2]), dtype=np.float32)
    for channel, plane in enumerate(cv2.split(image)):
        np.multiply(plane, np.float32(1 / 255), out=batch[0, channel])
    return batch


def _class_names(model: OnnxModel) -> tuple[str, ...]:
    text = model.metadata.get("classes")
    if text is None:
        return COCO_91
    try:
        names = json.loads(text)
    except ValueError:
        names = None
    if not isinstance(names, list) or not names or not all(isinstance(name, str) and name for name in names):
        raise ModelError(f'{model.path}: metadata_props["classes"] must be a JSON list of names; it is {text[:60]!r}')
    check_class_names(names, f'{model.path}: metadata_props["classes"]')
    return tuple(names)
