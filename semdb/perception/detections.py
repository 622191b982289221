"""What is made of a detector's output before it becomes rows: kept classes, clean masks, one detection per object.

The same rules hold for every detector, for keyframes and for queries; they are part of the detector's provenance.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace

import cv2
import numpy as np

from semdb.errors import UsageError
from semdb.perception._masks import Window, bounding_box
from semdb.perception.detectors.coco import INDOOR, NO_OBJECT
from semdb.perception.model_files import canonical_json
from semdb.perception.protocols import Detector
from semdb.settings import Settings
from semdb.types import BoolArray, Detection, ModelInfo

_MARGIN, _MARGIN_MIN = 0.01, 3  # around a dynamic object, of the image's longer side and in pixels: masks are not exact


@dataclass(frozen=True, slots=True)
class MaskRules:
    """How masks are cleaned and duplicates found; docs/models.md has what each does to two recordings.

    `part_share`: connected parts of a mask smaller than this share of the largest are dropped (a table behind the
    leg of a chair keeps both halves). `min_pixels`: so is a mask smaller than this. `depth_gap`: where an object is and
    how large comes from the part of its mask that is at one depth (`semdb.perception.objects.at_one_depth`); its mask
    stays, because a query often has no depth and must be described as the keyframes are. `duplicate_iou`: of two masks
    that overlap by this much the one with the lower score is dropped when it has the same class, or less than
    `rival_share` of the other's score: two classes with nearly the same score both stay, because from elsewhere the
    other one would win. `contained`: a mask with this share inside one of its own class with a higher score is dropped.
    """

    part_share: float = 0.3
    min_pixels: int = 64
    depth_gap: float = 0.1
    duplicate_iou: float = 0.7
    rival_share: float = 0.8
    contained: float = 0.85


@dataclass(frozen=True, slots=True)
class DetectionRules:
    """`classes` are the only ones kept (None: all), together with the `dynamic` ones: objects that move.

    No feature lies on a dynamic object, and it does not count where places are compared. `masks` None leaves masks as
    they are: those that come with a recording are exact.
    """

    classes: tuple[str, ...] | None = None
    dynamic: tuple[str, ...] = ()
    masks: MaskRules | None = field(default_factory=MaskRules)

    def apply(self, detections: Sequence[Detection]) -> tuple[Detection, ...]:
        """The objects of a detector's `detections`, by descending score."""
        return tuple(region.detection for region in self.regions(detections))

    def regions(self, detections: Sequence[Detection]) -> tuple[Region, ...]:
        """What `apply` gives, and where in the image it is."""
        kept = [d for d in detections if self.classes is None or d.category in (*self.classes, *self.dynamic)]
        if self.masks is None:
            return tuple(region_of(d) for d in kept)
        cleaned = [c for c in (clean_mask(d, self.masks) for d in kept) if c is not None]
        return without_duplicates(cleaned, self.masks)

    def still(self, detections: Sequence[Detection]) -> BoolArray | None:
        """Where features may lie ``[H, W]``: not on, nor close to, a dynamic object; None: all over."""
        return self.still_of([(d.category, d.mask) for d in detections])

    def still_of(self, objects: Sequence[tuple[str, BoolArray]]) -> BoolArray | None:
        """The same for classes and masks."""
        moving = [mask for category, mask in objects if category in self.dynamic]
        if not moving:
            return None
        covered = np.logical_or.reduce(moving).view(np.uint8)
        size = 2 * max(_MARGIN_MIN, round(_MARGIN * max(covered.shape))) + 1
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
        free: BoolArray = cv2.dilate(covered, kernel) == 0
        return free

    @property
    def depth_gap(self) -> float:
        """For `semdb.perception.objects.object_geometry`."""
        return 0.0 if self.masks is None else self.masks.depth_gap

    def info(self, detector: ModelInfo) -> ModelInfo:
        """Provenance of `detector` with these rules: other rules make rows that cannot be compared."""
        config = {**json.loads(detector.config), **(asdict(self.masks) if self.masks is not None else {})}
        if self.classes is not None:
            config["classes"] = sorted(self.classes)
        if self.dynamic:
            config["dynamic"] = sorted(self.dynamic)
        return replace(detector, config=canonical_json(config))


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """A detection, how many pixels its mask has, and the window about them: left column, top row, width, height."""

    detection: Detection
    area: int
    window: Window


def region_of(detection: Detection) -> Region:
    """The region of a detection as it is."""
    x, y, w, h = bounding_box(detection.mask)
    return Region(detection, int(np.count_nonzero(detection.mask[y : y + h, x : x + w])), (x, y, w, h))


def clean_mask(detection: Detection, rules: MaskRules) -> Region | None:
    """`detection` with the main part of its mask and the box about that; None when too little is left.

    A box changes only where its mask lost parts.
    """
    x, y, w, h = bounding_box(detection.mask)
    inside = np.ascontiguousarray(detection.mask[y : y + h, x : x + w])
    before = int(np.count_nonzero(inside))
    part = _main_parts(inside, rules.part_share)
    area = before if part is inside else int(np.count_nonzero(part))
    if area < rules.min_pixels:
        return None
    if area == before:
        return Region(detection, area, (x, y, w, h))
    mask = np.zeros_like(detection.mask)
    mask[y : y + h, x : x + w] = part
    px, py, pw, ph = bounding_box(part)
    limits = np.array([x + px, y + py, x + px + pw - 1, y + py + ph - 1], dtype=np.float32)
    old = detection.box
    box = np.concatenate([np.maximum(old[:2], limits[:2]), np.minimum(old[2:], limits[2:])]).astype(np.float32)
    return Region(replace(detection, mask=mask, box=box), area, (x + px, y + py, pw, ph))


def without_duplicates(regions: Sequence[Region], rules: MaskRules) -> tuple[Region, ...]:
    """`regions` by descending score, each object once (`MaskRules` says what is a duplicate); scores stay."""
    kept: list[Region] = []
    for candidate in sorted(regions, key=lambda region: -region.detection.score):
        if not any(_is_duplicate(candidate, other, rules) for other in kept):
            kept.append(candidate)
    return tuple(kept)


def _is_duplicate(candidate: Region, other: Region, rules: MaskRules) -> bool:
    """Whether `candidate` is a second detection of what `other` is, which has at least its score."""
    common = _common_pixels(candidate, other)
    if common == 0:
        return False
    same_class = candidate.detection.category == other.detection.category
    if common >= rules.duplicate_iou * (candidate.area + other.area - common):
        return same_class or candidate.detection.score < rules.rival_share * other.detection.score
    return same_class and common >= rules.contained * candidate.area


def _common_pixels(a: Region, b: Region) -> int:
    (ax, ay, aw, ah), (bx, by, bw, bh) = a.window, b.window
    left, right = max(ax, bx), min(ax + aw, bx + bw)
    top, bottom = max(ay, by), min(ay + ah, by + bh)
    if left >= right or top >= bottom:
        return 0
    window = np.s_[top:bottom, left:right]
    return int(np.count_nonzero(a.detection.mask[window] & b.detection.mask[window]))


def _main_parts(mask: BoolArray, share: float) -> BoolArray:
    """The largest connected part of `mask` and those of at least `share` of its area."""
    count, labels = cv2.connectedComponents(mask.view(np.uint8), connectivity=8)
    if count <= 2:  # most; statistics would take longer than the labels
        return mask
    areas = np.bincount(labels.ravel())[1:]
    keep = np.concatenate([[False], areas >= share * areas.max()])
    parts: BoolArray = keep[labels]
    return parts


def rules_of(settings: Settings, detector: Detector) -> DetectionRules:
    """The rules of `settings` for `detector`.

    Raises UsageError for a list of classes that names none, or one that `detector` does not know.
    """
    classes = None if settings.classes in (None, "all") else _parse_classes(settings.classes, "classes", detector)
    dynamic = () if settings.dynamic in (None, "none") else _parse_classes(settings.dynamic, "dynamic", detector)
    return DetectionRules(classes, dynamic, MaskRules() if detector.classes is not None else None)


def _parse_classes(text: str | None, name: str, detector: Detector) -> tuple[str, ...]:
    """``"chair, cup"`` as names, each once; ``indoor`` stands for those of `INDOOR` that the detector knows."""
    known = detector.classes
    names: dict[str, None] = {}
    for word in (part.strip() for part in (text or "").split(",")):
        if word == "indoor":
            names.update(dict.fromkeys(c for c in INDOOR if known is None or c in known))
        elif word and known is not None and word not in known:
            shown = ", ".join(sorted(set(known) - NO_OBJECT))
            raise UsageError(f"--{name} {word} (SEMDB_{name.upper()}): {detector.info.name} knows only {shown}")
        elif word:
            names[word] = None
    if not names:
        raise UsageError(f"--{name} {text!r} (SEMDB_{name.upper()}) names no class: write names divided by commas")
    return tuple(names)
