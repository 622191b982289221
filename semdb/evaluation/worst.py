"""The queries to look at first, as pictures: query and keyframe side by side with what was matched."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from semdb.errors import FrameError
from semdb.evaluation.baselines import nearest_in_pose
from semdb.evaluation.failures import explain, median_sharpness
from semdb.evaluation.metrics import EvaluationResult, QueryResult
from semdb.evaluation.runs import Run
from semdb.evaluation.tasks import Task
from semdb.localization.query_scale import smaller_camera, smaller_image, times_finer
from semdb.pictures.drawing import draw_localization
from semdb.shown import measure
from semdb.types import Detection, Float32Array, ImageArray, Localization

WORST = 10
WIDTH = 1280  # pixels of a picture in a report
JPEG_QUALITY = 82


def worst_queries(result: EvaluationResult, count: int = WORST) -> list[QueryResult]:
    """The `count` queries to look at first: false localizations by error, then failures, then the largest errors."""

    def order(query: QueryResult) -> tuple[int, float]:
        rank = 0 if query.is_false else 1 if not query.is_localized else 2
        error = (query.translation_m or 0.0) / 0.25 + (query.rotation_deg or 0.0) / 5.0
        return rank, -error if math.isfinite(error) else 0.0

    return sorted(result.per_query, key=order)[:count]


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """What is kept of a localization until it is known whether it is among the worst: kilobytes per query."""

    keyframe_id: int | None
    query_xy: Float32Array | None
    keyframe_xy: Float32Array | None

    @classmethod
    def of(cls, found: Localization) -> Shown:
        return cls(found.best_keyframe_id, found.query_xy, found.keyframe_xy)


@dataclass(frozen=True, slots=True, eq=False)
class PackedDetection:
    """A detection whose mask takes a kilobyte."""

    category: str
    score: float
    box: Float32Array
    shape: tuple[int, int]
    mask: bytes

    @classmethod
    def of(cls, thing: Detection) -> PackedDetection:
        height, width = thing.mask.shape
        packed = zlib.compress(np.packbits(thing.mask).tobytes(), 1)
        return cls(thing.category, thing.score, thing.box, (height, width), packed)

    def unpack(self) -> Detection:
        bits = np.frombuffer(zlib.decompress(self.mask), np.uint8)
        mask = np.unpackbits(bits, count=self.shape[0] * self.shape[1]).reshape(self.shape).astype(np.bool_)
        return Detection(self.category, self.score, self.box, mask)


Key = tuple[str, int]


def draw_worst(
    result: EvaluationResult,
    task: Task,
    run: Run,
    shown: Mapping[Key, Shown],
    objects: Mapping[Key, Sequence[PackedDetection]],
    count: int = WORST,
) -> dict[Key, bytes]:
    """JPEG pictures of the `count` worst queries of `result`, by recording and frame index.

    Where no keyframe agreed with the query, the one nearest in true pose is shown without matches, and named so.
    """
    images = _Images(task)
    usual = median_sharpness(result.per_query)
    pictures = {}
    for query in worst_queries(result, count):
        key = query.recording, query.frame_index
        image = images.read(*key)
        if image is None:
            continue
        things = [packed.unpack() for packed in objects.get(key, ())]
        pictures[key] = _jpeg(_draw(query, image, things, shown[key], run, images, usual))
    return pictures


def _draw(
    query: QueryResult,
    image: ImageArray,
    things: Sequence[Detection],
    shown: Shown,
    run: Run,
    images: _Images,
    usual_sharpness: float | None,
) -> ImageArray:
    name, index, label = query.candidate_recording, query.candidate, "best keyframe"
    keyframe_things: tuple[Detection, ...] = ()
    agreed = name is not None and index is not None and shown.keyframe_id is not None
    if query.true_world_from_camera is not None and len(run.poses):
        nearest = nearest_in_pose(query.true_world_from_camera, run.poses, 1)[0]
        if not agreed:
            name, index, keyframe_things = run.keyframe(nearest)
            label = "no keyframe agreed; nearest in true pose"
    if agreed:
        position = run.position_of(shown.keyframe_id)
        keyframe_things = () if position is None else run.keyframe(position)[2]
    keyframe = None if name is None or index is None else images.read(name, index)
    return draw_localization(
        image,
        things,
        keyframe,
        keyframe_things,
        shown.query_xy if agreed else None,
        shown.keyframe_xy if agreed else None,
        title=f"{query.recording}  {query.frame}",
        verdict=query.verdict,
        facts=_facts(query, usual_sharpness),
        keyframe_label=f"{label}: {name}, frame {index}",
    )


def _facts(query: QueryResult, usual_sharpness: float | None) -> list[tuple[str, str]]:
    facts = [("inliers", str(query.inliers))]
    if query.confidence is not None:
        facts.append(("confidence", measure(query.confidence, 2, unless=(0.0, 1.0))))
    if query.translation_m is not None and query.rotation_deg is not None:
        facts.append(("off the true pose", f"{100 * query.translation_m:.1f} cm  {query.rotation_deg:.2f}°"))
    facts.append(("why", explain(query, usual_sharpness)))
    return facts


class _Images:
    """Colour images of a task by recording and frame index; None for what cannot be read."""

    def __init__(self, task: Task) -> None:
        self._recordings = {recording.name: recording for recording in task.recordings}
        self._known = task.map_cameras
        self._entries = {
            (recording.name, entry.index): entry for recording in task.recordings for entry in recording.entries
        }

    def read(self, name: str, index: int) -> ImageArray | None:
        entry = self._entries.get((name, index))
        if entry is None:
            return None
        try:
            camera = self._recordings[name].camera_of(entry)
            image = self._recordings[name].read_image(entry)
        except FrameError:
            return None
        times = times_finer(camera, self._known)  # as it was asked
        return image if times == 1 else smaller_image(image, smaller_camera(camera, times))


def _jpeg(image: ImageArray) -> bytes:
    height = round(image.shape[0] * WIDTH / image.shape[1])
    small = cv2.resize(image, (WIDTH, height), interpolation=cv2.INTER_AREA)
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    encoded: bytes = cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), options)[1].tobytes()
    return encoded
