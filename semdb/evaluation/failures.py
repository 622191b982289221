"""Why a query failed or is far off: what a person would find out by looking, in one line."""

from __future__ import annotations

import cv2
import numpy as np

from semdb.evaluation.metrics import QueryResult
from semdb.evaluation.retrieval import NEAR_ROTATION_DEG, NEAR_TRANSLATION_M
from semdb.types import ImageArray, Verdict

BLURRED = 0.4  # of the median sharpness of the queries: below this edges are visibly smeared


def sharpness(image: ImageArray) -> float:
    """Variance of the Laplacian of the grey image ``[H, W, 3]``, a usual measure of focus and motion blur."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


def median_sharpness(queries: tuple[QueryResult, ...]) -> float | None:
    """Over the queries that know theirs."""
    known = [query.sharpness for query in queries if query.sharpness is not None]
    return float(np.median(known)) if known else None


def explain(query: QueryResult, usual_sharpness: float | None = None) -> str:
    """Where on the way from image to pose it went wrong; `usual_sharpness` is that of the other queries.

    Follows the way of a query: does the map know the place, was it retrieved, was it matched, is the pose right?
    """
    parts = [_step(query)]
    if usual_sharpness and query.sharpness is not None and query.sharpness < BLURRED * usual_sharpness:
        parts.append(f"the image is blurred: sharpness {query.sharpness / usual_sharpness:.0%} of the usual")
    return "; ".join(parts)


def _step(query: QueryResult) -> str:
    near = (
        ""
        if query.nearest_keyframe_m is None or query.nearest_keyframe_deg is None
        else f"{query.nearest_keyframe_m:.2f} m and {query.nearest_keyframe_deg:.0f}° away"
    )
    if query.keyframe_in_reach is False:
        first = f"the map does not know the place well: the nearest keyframe is {near}"
    elif query.keyframe_in_reach and query.retrieves and query.retrieval_rank is None:
        first = (
            f"retrieval missed: no keyframe within {NEAR_TRANSLATION_M:g} m and {NEAR_ROTATION_DEG:g}° among the "
            f"first ten (the nearest is {near})"
        )
    elif query.retrieves and query.retrieval_rank is not None and query.retrieval_rank > query.keyframes_matched:
        first = (
            f"the right keyframe was number {query.retrieval_rank} in the ranking, but only {query.keyframes_matched} "
            "were matched"
        )
    else:
        first = ""
    end = _end(query)
    if not first and near and query.is_localized and not query.is_false:
        end += f"; the nearest keyframe is {near}"
    return "; ".join(part for part in (first, end) if part)


def _end(query: QueryResult) -> str:
    if query.verdict is Verdict.FAILED:
        return f"too little agreed ({query.inliers} inliers)"
    if query.verdict is Verdict.AMBIGUOUS:
        return "a pose was found but not trusted"
    if query.verdict is Verdict.COARSE:
        return "a pose by landmarks alone"
    if query.is_false:
        return f"a wrong pose was trusted ({query.inliers} inliers)"
    return "right, but among the largest errors"
