"""Faster R-CNN and SSD of torchvision: detectors that give boxes, which `box_masks` fills."""

from __future__ import annotations

from typing import Any

import numpy as np

from semdb.errors import ModelError
from semdb.perception.box_masks import box_mask, filled
from semdb.perception.detectors.coco import COCO_91, NO_OBJECT
from semdb.perception.detectors.onnx import NO_MASK, WEAK_THRESHOLD, image_to_batch
from semdb.perception.model_files import canonical_json, file_sha256, first_line, resolve_file
from semdb.perception.protocols import Detector
from semdb.perception.torch_models import import_torch, load_weights, prepare, read_checkpoint, state_dict_of
from semdb.settings import Settings
from semdb.types import Detection, Float32Array, ImageArray, InstanceMasks, ModelInfo

BOX_SPECS = {
    "fasterrcnn:": "fasterrcnn_resnet50_fpn",
    "ssd:": "ssd300_vgg16",
}


class BoxDetector:
    """``fasterrcnn:PATH`` or ``ssd:PATH``: a checkpoint of torchvision's network of that name, 91 classes of COCO.

    Detections have their whole box as mask; with depth the describer fills them by it (`boxes_only` asks for that).
    Those below ``settings.score_threshold`` are weak, those below 0.05 or of no class are dropped, as of Mask R-CNN.
    """

    boxes_only = True
    classes = COCO_91

    def __init__(self, spec: str, settings: Settings) -> None:
        self._torch = import_torch()
        import torchvision

        prefix = spec.partition(":")[0] + ":"
        name = BOX_SPECS[prefix]
        path = resolve_file(spec, prefix, "a checkpoint (.pth)", settings)
        make = getattr(torchvision.models.detection, name)
        network = make(weights=None, weights_backbone=None, num_classes=len(COCO_91))
        load_weights(network, state_dict_of(read_checkpoint(path), path), path, name)
        (network.roi_heads if hasattr(network, "roi_heads") else network).score_thresh = WEAK_THRESHOLD
        self._network = prepare(network, settings, self._torch)
        self._device = next(self._network.parameters()).device
        self._path, self._score_threshold = path, settings.score_threshold
        config = {
            "architecture": name,
            "masks": "box, or its depth",
            "score_threshold": settings.score_threshold,
            "weak_threshold": WEAK_THRESHOLD,
        }
        self.info = ModelInfo("detector", f"{prefix}{path.name}", file_sha256(path), canonical_json(config))

    def detect(self, image: ImageArray, instances: InstanceMasks | None = None) -> tuple[Detection, ...]:
        """Objects of an RGB `image` ``[H, W, 3]`` by descending score; `instances` are not used. Raises ModelError."""
        torch = self._torch
        try:
            with torch.inference_mode():
                (output,) = self._network([torch.from_numpy(image_to_batch(image)[0]).to(self._device)])
        except RuntimeError as error:  # torch's errors, out of memory among them
            size = f"{image.shape[1]}x{image.shape[0]}"
            raise ModelError(f"{self._path} failed on an image of {size}: {first_line(error)}") from error
        return self._detections(output, image.shape[1], image.shape[0])

    def _detections(self, output: dict[str, Any], width: int, height: int) -> tuple[Detection, ...]:
        boxes: Float32Array = output["boxes"].float().cpu().numpy()
        scores: Float32Array = output["scores"].float().cpu().numpy()
        labels = output["labels"].cpu().numpy()
        if not (np.isfinite(boxes).all() and np.isfinite(scores).all()):
            raise ModelError(f"{self._path} gave scores or boxes that are not finite: the file is damaged")
        limits = np.array([width - 1, height - 1, width - 1, height - 1], dtype=np.float32)
        found = []
        for k in np.argsort(-scores, kind="stable"):
            category = COCO_91[int(labels[k])]
            if category in NO_OBJECT:
                continue
            box: Float32Array = np.clip(boxes[k], 0, limits).astype(np.float32)
            weak = bool(scores[k] < self._score_threshold)
            mask = NO_MASK if weak else box_mask(box, (height, width))
            found.append(Detection(category, float(scores[k]), box, mask, weak))
        return tuple(found)


class BoxesOf:
    """``boxes:SPEC`` and ``whole-boxes:SPEC``: the boxes of another detector without its masks.

    What a mask brings is measured so. Boxes are filled by depth where there is one, whole boxes never.
    """

    def __init__(self, detector: Detector, *, by_depth: bool) -> None:
        self._detector = detector
        self.classes = detector.classes
        self.boxes_only = by_depth
        self.needs_masks: bool = getattr(detector, "needs_masks", False)
        kind = "boxes" if by_depth else "whole-boxes"
        info = detector.info
        self.info = ModelInfo("detector", f"{kind}:{info.name}", info.sha256, info.config)

    def detect(self, image: ImageArray, instances: InstanceMasks | None = None) -> tuple[Detection, ...]:
        """What the other detector finds, each with its whole box as mask."""
        height, width = image.shape[:2]
        return filled(self._detector.detect(image, instances), None, (height, width))
