"""Object detectors, one file each, found by their spec."""

from __future__ import annotations

from semdb.errors import ModelError, UsageError
from semdb.perception.protocols import Detector
from semdb.settings import Settings


def load_detector(spec: str, settings: Settings) -> Detector:
    """The detector of a `spec`: ``onnx:FILE`` or ``recorded``.

    The network runs on ``settings.threads`` threads; their number does not change the result.
    Raises UsageError for a spec that is none, ModelError when its file is missing or is no Mask R-CNN.
    """
    if spec == "recorded":
        from semdb.perception.detectors.recorded import RecordedDetector

        return RecordedDetector()
    if spec.startswith("onnx:"):
        from semdb.perception.detectors.onnx import OnnxDetector

        return OnnxDetector(spec, settings)
    if spec.startswith("torchvision:"):
        raise ModelError(
            f"{spec!r}: torch models come with `pip install semdb[torch]`, but this version of semdb runs Mask R-CNN "
            "only as onnx:FILE; export the model to ONNX and set SEMDB_DETECTOR=onnx:FILE"
        )
    raise UsageError(f"no detector {spec!r}: write onnx:FILE (a Mask R-CNN) or recorded (masks of the recording)")
