"""Mask R-CNN in torch, with torchvision's published weights or any checkpoint of the same architectures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from semdb.errors import ModelError
from semdb.perception import mask_rcnn
from semdb.perception.catalogue import BY_NAME
from semdb.perception.detectors.coco import COCO_91, NO_OBJECT
from semdb.perception.detectors.onnx import MASK_THRESHOLD, NO_MASK, WEAK_THRESHOLD, image_to_batch
from semdb.perception.mask_rcnn import Architecture
from semdb.perception.model_files import canonical_json, file_sha256, first_line
from semdb.perception.torch_models import (
    best_batch,
    import_torch,
    layer_precision,
    prepare,
    read_checkpoint,
    resolve_checkpoint,
    state_dict_of,
    to_device,
)
from semdb.settings import Settings
from semdb.storable_names import check_class_names
from semdb.types import Detection, Float32Array, ImageArray, InstanceMasks, ModelInfo

FORMAT = "semdb-detector"
"""``format`` in a checkpoint of `semdb train detector`, which also holds `architecture` and `classes`."""

_PUBLISHED = {
    # the first weights were trained with the epsilon of Caffe2's batch normalisation, which is none
    "maskrcnn_resnet50_fpn": Architecture("resnet50", 1, epsilon=0.0),
    "maskrcnn_resnet50_fpn_v2": Architecture("resnet50", 2),
}


class TorchvisionDetector:
    """Mask R-CNN in torch, on the device of the settings, in half precision on CUDA.

    Detections below ``settings.score_threshold`` are weak; those below 0.05, with an empty mask or with a label that
    stands for nothing are dropped, as with `onnx:` files. The device is not part of the provenance: it changes results
    by rounding only.
    """

    def __init__(self, spec: str, settings: Settings) -> None:
        self._torch = import_torch()
        path = resolve_checkpoint(spec, settings)
        network, self.architecture, self.classes = load_detector_checkpoint(path, known_architecture(spec))
        network.roi_heads.score_thresh = WEAK_THRESHOLD
        self._score_threshold = settings.score_threshold
        self._network = prepare(network, settings, self._torch)
        self._device = next(self._network.parameters()).device
        self.best_batch = best_batch(self._device)
        self._path = path
        config = {
            "architecture": self.architecture.name,
            "batch_norm_epsilon": self.architecture.epsilon,
            "mask_threshold": MASK_THRESHOLD,
            "min_size": self.architecture.min_size,
            "max_size": self.architecture.max_size,
            "score_threshold": settings.score_threshold,
            "weak_threshold": WEAK_THRESHOLD,
        }
        name = _name_of(spec) if _name_of(spec) in BY_NAME else path.name
        self.info = ModelInfo("detector", f"torchvision:{name}", file_sha256(path), canonical_json(config))

    def detect(self, image: ImageArray, instances: InstanceMasks | None = None) -> tuple[Detection, ...]:
        """Objects of an RGB `image` ``[H, W, 3]`` by descending score; `instances` are not used.

        Raises ModelError when the network fails, as when the device's memory is full.
        """
        return self.detect_batch([image])[0]

    def detect_batch(self, images: Sequence[ImageArray]) -> list[tuple[Detection, ...]]:
        """The objects of each of `images`, as `detect` gives them; images of one size go through the network together.

        Images of several sizes would be padded to one, which changes what is found at their borders.
        """
        found: list[tuple[Detection, ...]] = [()] * len(images)
        for size in dict.fromkeys(image.shape for image in images):
            members = [k for k, image in enumerate(images) if image.shape == size]
            outputs = self._run([images[k] for k in members])
            for k, output in zip(members, outputs, strict=True):
                found[k] = self._detections(output, images[k].shape[1], images[k].shape[0])
        return found

    def _run(self, images: Sequence[ImageArray]) -> list[dict[str, Any]]:
        torch = self._torch
        try:
            with torch.inference_mode(), layer_precision(self._device, torch):
                return mask_rcnn.infer(self._network, image_tensors(images, self._device, torch), self._score_threshold)
        except RuntimeError as error:  # torch's errors, out of memory among them
            what = f"{len(images)} images of {images[0].shape[1]}x{images[0].shape[0]}"
            raise ModelError(f"{self._path} failed on {what} on {self._device}: {first_line(error)}") from error

    def _detections(self, output: dict[str, Any], width: int, height: int) -> tuple[Detection, ...]:
        boxes: Float32Array = output["boxes"].float().cpu().numpy()
        scores: Float32Array = output["scores"].float().cpu().numpy()
        labels = output["labels"].cpu().numpy()
        masks = (output["masks"][:, 0] >= MASK_THRESHOLD).cpu().numpy()  # cut on the device: a quarter of the bytes
        if not (np.isfinite(boxes).all() and np.isfinite(scores).all()):
            raise ModelError(f"{self._path} gave scores or boxes that are not finite: the file is damaged")
        limits = np.array([width - 1, height - 1, width - 1, height - 1], dtype=np.float32)
        found = []
        for k in np.argsort(-scores, kind="stable"):
            category = self.classes[int(labels[k])]
            weak = bool(scores[k] < self._score_threshold)
            mask = NO_MASK if weak else masks[k].copy()
            if category not in NO_OBJECT and (weak or mask.any()):
                box: Float32Array = np.clip(boxes[k], 0, limits).astype(np.float32)
                found.append(Detection(category, float(scores[k]), box, mask, weak))
        return tuple(found)


def load_detector_checkpoint(
    path: Path, known: Architecture | None = None
) -> tuple[Any, Architecture, tuple[str, ...]]:
    """The network of a checkpoint (torchvision's, or one of `semdb train`), what it is, and its class names.

    `known` is what the file must be. Raises ModelError when it is not a Mask R-CNN, or its classes have no names.
    """
    content = read_checkpoint(path)
    classes: tuple[str, ...] = COCO_91
    if content.get("format") == FORMAT:
        try:
            known = Architecture(**content["architecture"])
            classes = tuple(str(name) for name in content["classes"])
        except (KeyError, TypeError) as error:
            raise ModelError(f"{path} is a damaged checkpoint of semdb train ({first_line(error)})") from error
        check_class_names(classes, str(path))
    elif known is None and file_sha256(path).startswith(BY_NAME["maskrcnn_resnet50_fpn"].sha256):
        known = _PUBLISHED["maskrcnn_resnet50_fpn"]
    network, architecture = mask_rcnn.load(state_dict_of(content, path), path, known)
    count = network.roi_heads.box_predictor.cls_score.out_features
    if count != len(classes):
        raise ModelError(
            f"{path} knows {count} classes, but without a list of names they must be COCO's {len(COCO_91)}: "
            "only checkpoints of semdb train bring their own names"
        )
    return network, architecture, classes


def known_architecture(spec: str) -> Architecture | None:
    """What the file of a published ``torchvision:NAME`` must be; None for a path."""
    return _PUBLISHED.get(_name_of(spec))


def image_tensor(image: ImageArray, torch: Any) -> Any:
    """`image` ``[H, W, 3]`` as a float32 tensor ``[3, H, W]`` from 0 to 1."""
    return torch.from_numpy(image_to_batch(image)[0])


def image_tensors(images: Sequence[ImageArray], device: Any, torch: Any) -> list[Any]:
    """`images` of one size as `image_tensor` gives them, on `device`.

    They go there as bytes, a quarter of the size, in one transfer; the device makes the floats.
    """
    batch = to_device(np.stack(images), device, torch).permute(0, 3, 1, 2)
    return list(batch.to(torch.float32, memory_format=torch.contiguous_format).mul_(1 / 255))


def _name_of(spec: str) -> str:
    return spec.removeprefix("torchvision:")
