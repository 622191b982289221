"""Object detectors, one file each, found by their spec."""

from __future__ import annotations

from semdb.errors import UsageError
from semdb.perception.protocols import Detector
from semdb.settings import Settings


def load_detector(spec: str, settings: Settings) -> Detector:
    """The detector of a `spec`: ``onnx:FILE``, ``torchvision:NAME``, ``torchvision:PATH`` or ``recorded``.

    Of boxes only are ``fasterrcnn:PATH`` and ``ssd:PATH``, and ``boxes:SPEC`` and ``whole-boxes:SPEC``, which are
    another one without its masks.

    The network runs on ``settings.device``, on the CPU with ``settings.threads`` threads.
    Raises UsageError for a spec that is none, ModelError when its file is missing or is no Mask R-CNN.
    """
    if spec == "recorded":
        from semdb.perception.detectors.recorded import RecordedDetector

        return RecordedDetector()
    if spec.startswith("onnx:"):
        from semdb.perception.detectors.onnx import OnnxDetector

        return OnnxDetector(spec, settings)
    if spec.startswith("torchvision:"):
        from semdb.perception.detectors.torchvision import TorchvisionDetector

        return TorchvisionDetector(spec, settings)
    if spec.startswith(("boxes:", "whole-boxes:")):
        from semdb.perception.detectors.boxes import BoxesOf

        kind, _, other = spec.partition(":")
        return BoxesOf(load_detector(other, settings), by_depth=kind == "boxes")
    if spec.startswith(("fasterrcnn:", "ssd:")):
        from semdb.perception.detectors.boxes import BoxDetector

        return BoxDetector(spec, settings)
    raise UsageError(
        f"no detector {spec!r}: write onnx:FILE (a Mask R-CNN), torchvision:maskrcnn_resnet50_fpn_v2 (or the path of a "
        "checkpoint), fasterrcnn:FILE or ssd:FILE (boxes only) or recorded (masks of the recording)"
    )
