"""COCO's average precision and recall of a detector, for boxes and masks (Table 2 of the paper)."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from semdb.errors import ModelError, TrainingError, UsageError
from semdb.perception.protocols import Detector
from semdb.training.coco import CocoData, Instance, Picture, mask_of, read_marked_picture
from semdb.types import Detection

Progress = Callable[[int, int], None]
MEASURES = ("AP", "AP50", "AP75", "AR")
_ROWS = (0, 1, 2, 8)  # of the twelve numbers that COCO's evaluator gives; 8 is the recall with 100 detections
LEAST_SCORE = 0.05


@dataclass(frozen=True, slots=True)
class Scores:
    """`ap`, `ap50`, `ap75` and `ar` from 0 to 1; -1 where there is nothing to find."""

    ap: float
    ap50: float
    ap75: float
    ar: float

    @property
    def values(self) -> tuple[float, float, float, float]:
        return self.ap, self.ap50, self.ap75, self.ar


@dataclass(frozen=True, slots=True)
class DetectorScores:
    """Scores of boxes and masks, and the AP50 of the boxes of each class (-1 for one of which there is no object).

    `marked` counts images with an orientation mark, which is not applied.
    """

    boxes: Scores
    masks: Scores
    class_ap50: dict[str, float]
    images: int
    objects: int
    marked: int = 0


# the paper's detector (ResNet-101-FPN, fine-tuned) on COCO minival
PAPER = DetectorScores(Scores(0.354, 0.546, 0.385, 0.437), Scores(0.305, 0.513, 0.318, 0.384), {}, 5000, 0)


def evaluate_detector(detector: Detector, data: CocoData, progress: Progress | None = None) -> DetectorScores:
    """How well `detector` finds the objects of `data`, by COCO's own rules (pycocotools).

    The detector must have been loaded with a score threshold of `LEAST_SCORE`: precision is taken over all scores.
    Detections of classes that are not in `data` do not count, nor do those inside crowds. Raises ModelError when
    pycocotools is not installed, TrainingError when there is no object to find or the detector knows none of the
    classes, UsageError when it is no network.
    """
    if detector.classes is None:
        raise UsageError(f"{detector.info.name} takes masks that come with a recording: nothing to measure")
    try:
        from pycocotools import mask as rle
        from pycocotools.coco import COCO
    except ImportError as error:
        raise ModelError("the evaluation needs pycocotools: pip install 'semdb[torch]'") from error
    if not set(detector.classes) & set(data.classes[1:]):
        wanted = ", ".join(data.classes[1:])
        raise TrainingError(f"{detector.info.name} knows none of the classes of {data.file}: {wanted}")
    objects = sum(not one.crowd for picture in data.pictures for one in (*picture.instances, *picture.others))
    if not objects:
        raise TrainingError(
            f"{data.file} has no annotation of the classes {', '.join(data.classes[1:])} in its {len(data.pictures)} "
            "images: there is nothing to measure"
        )
    ids = dict(zip(data.classes[1:], data.category_ids, strict=True))
    found: list[dict[str, Any]] = []
    marked = 0
    for done, picture in enumerate(data.pictures, start=1):
        image, mark = read_marked_picture(picture)
        marked += mark > 1
        for detection in detector.detect(image, None):
            if detection.category in ids and not detection.weak:
                found.append(_result(detection, picture, ids, rle))
        if progress is not None:
            progress(done, len(data.pictures))
    with contextlib.redirect_stdout(io.StringIO()):  # it prints its steps
        truth = COCO()
        truth.dataset = _dataset(data, rle)
        truth.createIndex()
        scores = {kind: _scores(truth, found, data, kind) for kind in ("bbox", "segm")}
    in_order = [data.classes[1 + k] for k in np.argsort(data.category_ids)]  # the evaluator sorts classes by id
    per_class = dict(zip(in_order, scores["bbox"][1], strict=True))
    return DetectorScores(scores["bbox"][0], scores["segm"][0], per_class, len(data.pictures), objects, marked)


def _scores(truth: Any, found: list[dict[str, Any]], data: CocoData, kind: str) -> tuple[Scores, Sequence[float]]:
    from pycocotools.cocoeval import COCOeval

    if not found:  # the evaluator does not take an empty list
        return Scores(0.0, 0.0, 0.0, 0.0), [0.0] * len(data.category_ids)
    results = truth.loadRes([dict(row) for row in found])
    evaluator = COCOeval(truth, results, kind)
    evaluator.params.catIds = list(data.category_ids)
    evaluator.evaluate()
    evaluator.accumulate()
    evaluator.summarize()
    precision = evaluator.eval["precision"][0, :, :, 0, -1]  # IoU 0.5: recall, class; all areas; most detections
    known = precision > -1
    sums = np.where(known, precision, 0).sum(axis=0)
    per_class = np.where(known.any(axis=0), sums / np.maximum(known.sum(axis=0), 1), -1.0)
    return Scores(*(float(evaluator.stats[row]) for row in _ROWS)), [float(value) for value in per_class]


def _result(detection: Detection, picture: Picture, ids: dict[str, int], rle: Any) -> dict[str, Any]:
    x0, y0, x1, y1 = (float(value) for value in detection.box)
    return {
        "image_id": picture.image_id,
        "category_id": ids[detection.category],
        "bbox": [x0, y0, x1 - x0, y1 - y0],
        "score": detection.score,
        "segmentation": rle.encode(np.asfortranarray(detection.mask.astype(np.uint8))),
    }


def _dataset(data: CocoData, rle: Any) -> dict[str, Any]:
    annotations = [
        _annotation(instance, picture, data, rle)
        for picture in data.pictures
        for instance in (*picture.instances, *picture.others)
    ]
    for number, annotation in enumerate(annotations, start=1):
        annotation["id"] = number
    return {
        "info": {},
        "images": [{"id": p.image_id, "width": p.width, "height": p.height} for p in data.pictures],
        "categories": [{"id": i, "name": n} for n, i in zip(data.classes[1:], data.category_ids, strict=True)],
        "annotations": annotations,
    }


def _annotation(instance: Instance, picture: Picture, data: CocoData, rle: Any) -> dict[str, Any]:
    mask = mask_of(instance, picture)
    segmentation = rle.encode(np.asfortranarray(mask.astype(np.uint8)))
    if isinstance(instance.segmentation, list):  # the evaluator fills other pixels along the edge than OpenCV
        polygons = [polygon for polygon in instance.segmentation if len(polygon) >= 6]
        if polygons:
            segmentation = rle.merge(rle.frPyObjects(polygons, picture.height, picture.width))
    return {
        "image_id": picture.image_id,
        "category_id": data.category_ids[instance.label - 1],
        "bbox": list(instance.box),
        "area": float(rle.area(segmentation)) if instance.area is None else instance.area,
        "iscrowd": int(instance.crowd),
        "segmentation": segmentation,
    }
