"""Local features, one file each, found by their spec."""

from __future__ import annotations

from semdb.errors import UsageError
from semdb.perception.protocols import FeatureExtractor
from semdb.settings import Settings

KNOWN = ("surf", "sift", "orb")
WEAK = "surf:weak"  # SURF with weak keypoints of images that give few


def load_features(spec: str, settings: Settings) -> FeatureExtractor:
    """The local feature of a `spec`: ``surf``, ``surf:weak``, ``sift``, ``orb`` or ``onnx:FILE``.

    An image has ``settings.max_keypoints`` at most.

    Raises UsageError for another spec, ModelError when a file is missing or is no feature.
    """
    if spec in ("surf", WEAK):
        from semdb.perception.features.surf_features import SurfFeatures

        return SurfFeatures(max_keypoints=settings.max_keypoints, threads=settings.threads, weak=spec == WEAK)
    if spec == "sift":
        from semdb.perception.features.sift import SiftFeatures

        return SiftFeatures(max_keypoints=settings.max_keypoints)
    if spec == "orb":
        from semdb.perception.features.orb import OrbFeatures

        return OrbFeatures(max_keypoints=settings.max_keypoints)
    if spec.startswith("onnx:"):
        from semdb.perception.features.onnx import OnnxFeatures

        return OnnxFeatures(spec, settings)
    raise UsageError(f"no local feature {spec!r}: SEMDB_FEATURES knows {', '.join(KNOWN)}, {WEAK} and onnx:FILE")
