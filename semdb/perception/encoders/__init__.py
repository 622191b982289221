"""Place encoders, one file each, found by their spec."""

from __future__ import annotations

from semdb.errors import ModelError, UsageError
from semdb.perception.protocols import Encoder
from semdb.settings import Settings


def load_encoder(spec: str, settings: Settings) -> Encoder:
    """The encoder of a `spec`: ``onnx:FILE`` or ``gist``.

    The network runs on ``settings.threads`` threads; their number does not change the result.
    Raises UsageError for a spec that is none, ModelError when its file is missing or is no encoder.
    """
    if spec == "gist":
        from semdb.perception.encoders.gist import GistEncoder

        return GistEncoder()
    if spec.startswith("onnx:"):
        from semdb.perception.encoders.onnx import OnnxEncoder

        return OnnxEncoder(spec, settings)
    if spec.startswith("torchvision:"):
        raise ModelError(
            f"{spec!r}: torch models come with `pip install semdb[torch]`, but this version of semdb runs encoders "
            "only as onnx:FILE or gist; export the model to ONNX and set SEMDB_ENCODER=onnx:FILE"
        )
    raise UsageError(f"no encoder {spec!r}: write onnx:FILE (image to `embedding`) or gist (needs no file)")
