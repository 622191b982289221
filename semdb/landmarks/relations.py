"""How things stand to each other, from their boxes and how sure these are.

Rules are soft: each is a product of factors from 0 to 1, and widths grow with the standard deviations of the boxes.
They follow what is used for scenes of boxes: support by footprint and height (SceneVerse, VLA-3D), containment in
classes that contain (VLA-3D), distance of boxes for nearness. docs/landmarks.md has them as a table.
"""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from scipy.spatial import cKDTree

from semdb.landmarks.boxes import footprint, shared_area, upright_axes
from semdb.landmarks.memo import Arrays, Forgetful, Memo, name_of, remembered
from semdb.landmarks.values import Landmark, LandmarkState
from semdb.types import FloatArray

RELATED = "related"  # kind of what is remembered
FLOOR_SCORE = 0.3  # relations of less are no rows
NEAR_M = 1.0  # boxes so far apart are near with a score of one half
NEXT_M = 0.35
LEAST_GROUND_M = 0.06  # sides of footprints: whether a book stands over another one hangs on no centimetre
REACH_M = 2.5  # from box to box: nothing is related beyond
HOLDS = frozenset(
    (
        "bathtub",
        "backpack",
        "bowl",
        "box",
        "cup",
        "handbag",
        "microwave",
        "oven",
        "refrigerator",
        "sink",
        "suitcase",
        "vase",
    )
)
# what one sits or lies in is lower than its highest point
SEATS = frozenset(("armchair", "bed", "bench", "chair", "couch", "toilet"))
OPEN_BELOW = frozenset(("bed", "bench", "chair", "desk", "dining table", "table"))


class Relation(StrEnum):
    """What a thing (first) is to another one (second)."""

    ON = "on"
    IN = "in"
    UNDER = "under"
    ABOVE = "above"
    NEXT_TO = "next_to"
    NEAR = "near"


@dataclass(frozen=True, slots=True)
class Related:
    """Landmark number `one` stands in a relation to landmark number `other`, as surely as `score` (0..1)."""

    one: int
    kind: Relation
    other: int
    score: float


@dataclass(frozen=True, slots=True, eq=False)
class _Standing:
    """A box along the upright axes of its map."""

    ground: FloatArray  # [4, 2] footprint, counter-clockwise
    low: float
    high: float
    area: float
    sigma: float
    category: str

    @property
    def values(self) -> list[float]:
        """All of it in numbers but the class."""
        return [*self.ground.ravel().tolist(), self.low, self.high, self.area, self.sigma]


def find_relations(
    landmarks: Sequence[Landmark],
    names: Sequence[str],
    up: FloatArray,
    floor_score: float = FLOOR_SCORE,
    memo: Memo | None = None,
) -> list[Related]:
    """All relations between landmarks that are not gone, by numbers and kind. `names` are those of the classes."""
    memo = memo or Forgetful()
    there = [k for k, thing in enumerate(landmarks) if thing.state is not LandmarkState.GONE]
    if len(there) < 2:
        return []
    axes = upright_axes(up)
    standing = {k: _standing(landmarks[k], names, axes) for k in there}
    centres = np.array([landmarks[k].box.centre for k in there])
    halves = np.array([float(np.linalg.norm(landmarks[k].box.size)) / 2 for k in there])
    pairs = cKDTree(centres).query_pairs(2 * float(halves.max()) + REACH_M, output_type="ndarray")
    one, other = pairs.min(axis=1), pairs.max(axis=1)
    apart = np.linalg.norm(centres[one] - centres[other], axis=1) - halves[one] - halves[other]
    one, other = one[apart <= REACH_M], other[apart <= REACH_M]
    order = np.lexsort((other, one))
    numbers, ends = np.array(there)[other[order]], np.searchsorted(one[order], np.arange(len(there)), side="right")
    found: list[Related] = []
    for k, start, end in zip(there, [0, *ends.tolist()], ends.tolist(), strict=False):
        found += _related(k, numbers[start:end].tolist(), standing, floor_score, memo)
    return sorted(found, key=lambda item: (item.one, item.other, item.kind))


def _related(
    k: int, others: Sequence[int], standing: Mapping[int, _Standing], least: float, memo: Memo
) -> list[Related]:
    """The relations of thing `k` with those of higher numbers that are near it."""

    def compute() -> Arrays:
        place = {number: row for row, number in enumerate((k, *others))}
        found = [one for n in others for one in _pair(k, standing[k], n, standing[n], least)]
        kinds = list(Relation)
        rows = [(place[one.one], kinds.index(one.kind), place[one.other]) for one in found]
        return {
            "rows": np.array(rows, np.int32).reshape(-1, 3),
            "score": np.array([one.score for one in found], np.float64),
        }

    if not others:
        return []
    of_all = [standing[number] for number in (k, *others)]
    name = name_of(least, np.array([one.values for one in of_all]), "\n".join(one.category for one in of_all))
    kept = remembered(memo, RELATED, name, compute)
    numbers, kinds = (k, *others), list(Relation)
    return [
        Related(numbers[a], kinds[kind], numbers[b], score)
        for (a, kind, b), score in zip(kept["rows"].tolist(), kept["score"].tolist(), strict=True)
    ]


def _standing(thing: Landmark, names: Sequence[str], axes: FloatArray) -> _Standing:
    size = np.maximum(thing.box.size, (LEAST_GROUND_M, LEAST_GROUND_M, 0.0))
    ground = footprint(replace(thing.box, size=size), axes)
    middle = float(thing.box.centre @ axes[:, 2])
    half = float(thing.box.size[2]) / 2
    sigma = float(np.sqrt(max(np.trace(thing.covariance) / 3, 0.0)))
    area = float(size[0] * size[1])
    return _Standing(ground, middle - half, middle + half, area, sigma, names[thing.category])


def _pair(k: int, one: _Standing, n: int, other: _Standing, least: float) -> list[Related]:
    shared = shared_area(one.ground, other.ground)
    gap = 0.0 if shared > 0 else polygon_distance(one.ground, other.ground)
    sigma = float(np.hypot(one.sigma, other.sigma))
    height_gap = max(one.low - other.high, other.low - one.high, 0.0)
    distance = float(np.hypot(gap, height_gap))
    found: list[tuple[int, Relation, int, float]] = []
    for a, first, b, second in ((k, one, n, other), (n, other, k, one)):
        for kind, value in _directed(first, second, shared, sigma).items():
            found.append((a, kind, b, value))
    tied = max((value for _, kind, _, value in found if kind is not Relation.ABOVE), default=0.0)
    near = _half(distance, NEAR_M, 0.25 + sigma)
    beside = _half(gap, NEXT_M, 0.08 + sigma) * _level(one, other) * (1 - tied)
    for a, b in ((k, n), (n, k)):
        found += [(a, Relation.NEAR, b, near), (a, Relation.NEXT_TO, b, beside)]
    return [Related(a, kind, b, round(value, 6)) for a, kind, b, value in found if value >= least]


def _directed(one: _Standing, other: _Standing, shared: float, sigma: float) -> dict[Relation, float]:
    """What `one` is to `other`, apart from distance."""
    share = shared / max(one.area, 1e-9)
    over = _half(-share, -0.4, 0.1)  # most of its footprint is over the other's
    either = _half(-shared / max(min(one.area, other.area), 1e-9), -0.4, 0.1)
    larger = _half(one.area / max(other.area, 1e-9), 1.5, 0.3)
    height = max(one.high - one.low, 1e-3)
    gap = one.low - other.high
    width = 0.04 + sigma
    touching = float(np.exp(-0.5 * (gap / width) ** 2)) if gap > 0 else float(np.exp(-0.5 * (gap / (2 * width)) ** 2))
    if gap < 0 and one.category not in SEATS | OPEN_BELOW and one.area < 0.7 * other.area:
        # a seat is lower than its chair; and what else lies on a table makes the box of the table higher
        lowest = 0.2 if other.category in SEATS else 0.3
        carries = other.category in SEATS | OPEN_BELOW or one.high > other.high - 0.02
        above = one.low > other.low + lowest * (other.high - other.low)
        touching = max(touching, 0.9 if carries and above else 0.0)
    inside_height = min(one.high, other.high) - max(one.low, other.low)
    held = over * _half(-inside_height / height, -0.6, 0.1) * _half(one.area / max(other.area, 1e-9), 1.0, 0.1)
    found = {
        Relation.ON: over * larger * touching,
        Relation.IN: held if other.category in HOLDS and one.category not in SEATS | OPEN_BELOW | HOLDS else 0.0,
        Relation.ABOVE: either * _half(-gap, -0.1, 0.03 + sigma),
    }
    below = other.low - one.high
    under = either * _half(-below, -0.1, 0.03 + sigma)
    if other.category in OPEN_BELOW and one.category != other.category:
        # its box reaches the floor, and what stands beneath it stands within its box
        stands = _half(-share, -0.5, 0.1) * _half(one.high - other.high, -0.05, 0.03 + sigma)
        under = max(under, stands * _half(one.low - other.low, 0.15, 0.05))
    found[Relation.UNDER] = under
    return found


def _level(one: _Standing, other: _Standing) -> float:
    """Whether two things stand at one height: they share some of it."""
    common = min(one.high, other.high) - max(one.low, other.low)
    least = max(min(one.high - one.low, other.high - other.low), 1e-3)
    return _half(-common / least, -0.25, 0.15)


def _half(value: float, middle: float, width: float) -> float:
    """1 far below `middle`, one half there, 0 far above: a logistic curve."""
    return float(1 / (1 + np.exp(min(max((value - middle) / max(width / 2, 1e-6), -60.0), 60.0))))


def polygon_distance(one: FloatArray, other: FloatArray) -> float:
    """Least distance of two convex polygons ``[n, 2]`` that do not meet."""
    return min(_to_edges(one, other), _to_edges(other, one))


def _to_edges(points: FloatArray, polygon: FloatArray) -> float:
    start, end = polygon, np.roll(polygon, -1, axis=0)
    along = end - start
    length = np.maximum((along * along).sum(axis=1), 1e-12)
    t = np.clip(((points[:, None] - start) * along).sum(axis=2) / length, 0, 1)
    away = points[:, None] - (start + t[..., None] * along)
    return float(np.sqrt((away * away).sum(axis=2)).min())
