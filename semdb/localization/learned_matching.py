"""Matching of learned features: their thresholds, and networks that match in place of nearest neighbours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from semdb.byte_descriptors import as_float
from semdb.localization.matching import BACKGROUND, Evidence, Matches, MatchingOptions
from semdb.localization.views import View
from semdb.types import Float32Array, IntArray, ModelInfo

# Measured with XFeat on few keyframes (docs/features.md). Mutual nearest neighbours alone are more pairs, but a smaller
# share of them agrees, which is what tells right poses from wrong ones. Near a projection the nearest one is.
RATIO, GUIDED_RATIO, CEILING, GUIDED_CEILING = 0.85, 1.0, 0.36, 0.5


class KeypointMatcher(Protocol):
    """Pairs the keypoints of two images, seeing all of both (`semdb.perception.matchers`)."""

    def match(
        self,
        first_xy: Float32Array,
        first: npt.NDArray[np.generic],
        first_size: tuple[int, int],
        second_xy: Float32Array,
        second: npt.NDArray[np.generic],
        second_size: tuple[int, int],
    ) -> tuple[IntArray, IntArray]: ...


def is_learned(models: Sequence[ModelInfo]) -> bool:
    """Whether the local feature among `models` is a network."""
    return any(model.role == "features" and model.name.startswith("onnx:") for model in models)


def for_learned(options: MatchingOptions) -> MatchingOptions:
    """`options` with the thresholds of learned features; what keypoints may match stays as it is."""
    return replace(
        options,
        ratio=RATIO,
        contradiction_ratio=RATIO,
        guided_ratio=GUIDED_RATIO,
        ceiling=CEILING,
        guided_ceiling=GUIDED_CEILING,
    )


def match_by(matcher: KeypointMatcher, query: View, keyframe: View, options: MatchingOptions) -> Matches:
    """What `matcher` pairs, sorted by the query's index."""
    sizes = [(view.camera.width, view.camera.height) for view in (query, keyframe)]
    one, two = (as_float(view.descriptors) for view in (query, keyframe))
    i, j = matcher.match(query.seen_xy, one, sizes[0], keyframe.seen_xy, two, sizes[1])
    same = (query.classes[i] == keyframe.classes[j]) & (query.classes[i] != BACKGROUND)
    if options.evidence is Evidence.OBJECTS:
        i, j, same = i[same], j[same], same[same]
    product = np.einsum("nd,nd->n", np.asarray(one[i], np.float32), np.asarray(two[j], np.float32))
    return Matches(i, j, np.asarray(np.maximum(2 - 2 * product, 0), np.float32), same)
