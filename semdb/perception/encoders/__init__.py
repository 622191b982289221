"""Place encoders, one file each, found by their spec."""

from __future__ import annotations

from semdb.errors import UsageError
from semdb.perception.protocols import Encoder
from semdb.settings import Settings


def load_encoder(spec: str, settings: Settings) -> Encoder:
    """The encoder of a `spec`: ``onnx:FILE``, ``torchvision:NAME``, ``torchvision:PATH`` or ``gist``.

    The network runs on ``settings.device``, on the CPU with ``settings.threads`` threads.
    Raises UsageError for a spec that is none, ModelError when its file is missing or is no encoder.
    """
    if spec == "gist":
        from semdb.perception.encoders.gist import GistEncoder

        return GistEncoder()
    if spec.startswith("onnx:"):
        from semdb.perception.encoders.onnx import OnnxEncoder

        return OnnxEncoder(spec, settings)
    if spec.startswith("torchvision:"):
        from semdb.perception.encoders.torchvision import TorchvisionEncoder

        return TorchvisionEncoder(spec, settings)
    raise UsageError(
        f"no encoder {spec!r}: write onnx:FILE (image to `embedding`), torchvision:resnet50-places365 (or resnet50, or "
        "the path of a checkpoint) or gist (needs no file)"
    )
