"""Which classes are taken for each other: made-up objects whose places and names are known."""

from __future__ import annotations

import numpy as np
import pytest

from semdb.class_score import expand
from semdb.refinement.confusion import Confusion, ConfusionOptions, PlacedObjects, co_detections, confusions

BED, COUCH, CUP = 0, 1, 2


def placed(rows: list[tuple[int, int, tuple[float, float, float], float]]) -> PlacedObjects:
    return PlacedObjects(
        np.array([row[0] for row in rows], np.int64),
        np.array([row[1] for row in rows], np.int64),
        np.array([row[2] for row in rows], np.float64).reshape(-1, 3),
        np.array([row[3] for row in rows], np.float64),
    )


def sofa_and_cups() -> PlacedObjects:
    """A couch that one of four keyframes takes for a bed, a cup on it in each, and a cup elsewhere."""
    rows = []
    for keyframe in range(4):
        name = BED if keyframe == 3 else COUCH
        rows.append((keyframe, name, (2.0 + 0.05 * keyframe, 0.0, 0.4), 1.0))
        rows.append((keyframe, CUP, (2.0, 0.0, 0.8), 0.06))
        rows.append((keyframe, CUP, (-1.0 - keyframe, 0.0, 0.8), 0.06))
    return placed(rows)


def test_objects_of_other_keyframes_at_one_place_are_counted_by_class() -> None:
    counts = co_detections(sofa_and_cups(), 3)
    assert counts.tolist() == [[0, 3, 0], [3, 6, 0], [0, 0, 12]]


def test_objects_of_one_keyframe_or_of_other_sizes_or_apart_are_not() -> None:
    here = (0.0, 0.0, 1.0)
    assert co_detections(placed([(0, BED, here, 1.0), (0, COUCH, here, 1.0)]), 2).sum() == 0
    assert co_detections(placed([(0, BED, here, 1.0), (1, COUCH, here, 0.4)]), 2).sum() == 0
    assert co_detections(placed([(0, BED, here, 1.0), (1, COUCH, (0.51, 0.0, 1.0), 1.0)]), 2).sum() == 0
    assert co_detections(placed([(0, BED, here, 1.0), (1, COUCH, (0.5, 0.0, 1.0), 1.0)]), 2).sum() == 2
    assert co_detections(placed([]), 2).shape == (2, 2)


def test_the_order_of_objects_changes_nothing() -> None:
    rng = np.random.default_rng(3)
    rows = [
        (int(rng.integers(30)), int(rng.integers(5)), tuple(rng.uniform(0, 2, 3)), float(rng.uniform(0.2, 1)))
        for _ in range(400)
    ]
    expected = co_detections(placed(rows), 5)
    assert expected.sum() > 500
    for _ in range(3):
        assert (co_detections(placed([rows[k] for k in rng.permutation(len(rows))]), 5) == expected).all()


def test_weights_are_shares_of_what_was_found_at_the_places_of_a_class() -> None:
    counts = np.array([[0, 3, 0], [3, 6, 1], [0, 1, 500]], np.int64)
    assert confusions(counts) == [
        Confusion(BED, COUCH, 3, 3 * 1_000_000 // (3 + 4)),
        Confusion(COUCH, BED, 3, 3 * 1_000_000 // (10 + 4)),
    ]
    lenient = ConfusionOptions(minimum_pairs=1, minimum_weight=0.0, prior=0)
    assert Confusion(CUP, COUCH, 1, 1_000_000 // 501) in confusions(counts, lenient)


def test_a_query_asks_for_what_its_classes_are_taken_for() -> None:
    weights = {"couch": {"bed": 400_000}, "chair": {"bed": 100_000, "couch": 50_000}}
    assert expand({"couch": 16, "chair": 32, "cup": 5}, weights, 1.0) == {
        "couch": 16,  # what is seen counts more than what a chair stands for
        "chair": 32,
        "cup": 5,
        "bed": 9,  # (16 * 0.4 + 32 * 0.1) rounded down
    }
    assert expand({"couch": 16}, weights, 0.5) == {"couch": 16, "bed": 3}
    assert expand({"couch": 16}, {}, 1.0) == {"couch": 16}
    assert expand({}, weights, 1.0) == {}


@pytest.mark.parametrize("share", [0.0, 0.001])
def test_no_share_adds_no_class(share: float) -> None:
    assert expand({"couch": 16}, {"couch": {"bed": 900_000}}, share) == {"couch": 16}
