"""What is made of a detector's output before it becomes rows."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from semdb.errors import UsageError
from semdb.perception._masks import bounding_box
from semdb.perception.describe import Describer
from semdb.perception.detections import DetectionRules, MaskRules, rules_of
from semdb.perception.detectors.coco import COCO_91, INDOOR
from semdb.perception.detectors.recorded import RecordedDetector
from semdb.perception.encoders import load_encoder
from semdb.perception.features import load_features
from semdb.perception.model_choice import settings_of_map
from semdb.perception.objects import at_one_depth, object_geometry
from semdb.settings import Settings
from semdb.types import Camera, Detection, Features, ImageArray, InstanceMasks, ModelInfo

HEIGHT, WIDTH = 120, 160


def rectangle(x: int, y: int, width: int, height: int) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
    mask[y : y + height, x : x + width] = True
    return mask


def thing(mask: np.ndarray, category: str = "chair", score: float = 0.9) -> Detection:
    v, u = np.nonzero(mask)
    box = np.array([u.min() - 1.5, v.min(), u.max(), v.max() + 0.5], dtype=np.float32)
    return Detection(category, score, box, mask)


def names(detections: tuple[Detection, ...]) -> list[tuple[str, float]]:
    return [(d.category, d.score) for d in detections]


class Fake:
    """A detector that finds what it is told to find."""

    def __init__(self, *found: Detection, classes: tuple[str, ...] | None = COCO_91) -> None:
        self.found, self.classes = found, classes
        self.info = ModelInfo("detector", "fake", "ab", '{"score_threshold":0.5}')

    def detect(self, image: ImageArray, instances: InstanceMasks | None) -> tuple[Detection, ...]:
        return self.found


def test_of_two_of_one_class_the_better_stays() -> None:
    a, b = thing(rectangle(10, 10, 60, 60), score=0.7), thing(rectangle(12, 12, 60, 60), score=0.9)
    found = DetectionRules().apply((a, b))
    assert found == (b,)


def test_a_bench_over_a_chair_is_one_thing() -> None:
    chair, bench = thing(rectangle(10, 10, 60, 60), "chair", 0.95), thing(rectangle(10, 12, 60, 60), "bench", 0.6)
    assert names(DetectionRules().apply((bench, chair))) == [("chair", 0.95)]


def test_two_classes_that_are_nearly_as_sure_both_stay() -> None:
    laptop, tv = thing(rectangle(10, 10, 60, 60), "laptop", 0.8), thing(rectangle(10, 12, 60, 60), "tv", 0.7)
    assert names(DetectionRules().apply((laptop, tv))) == [("laptop", 0.8), ("tv", 0.7)]


def test_a_part_of_the_same_class_is_no_thing_but_a_cup_on_a_table_is() -> None:
    table = thing(rectangle(10, 10, 100, 100), "dining table", 0.9)
    leg = thing(rectangle(20, 20, 20, 60), "dining table", 0.6)
    cup = thing(rectangle(50, 50, 20, 20), "cup", 0.6)
    assert names(DetectionRules().apply((table, leg, cup))) == [("dining table", 0.9), ("cup", 0.6)]


def test_neighbours_that_overlap_a_little_are_two() -> None:
    a, b = thing(rectangle(10, 10, 60, 60), score=0.9), thing(rectangle(40, 10, 60, 60), score=0.8)
    assert len(DetectionRules().apply((a, b))) == 2


def test_specks_go_and_the_box_follows_the_mask() -> None:
    mask = rectangle(20, 20, 40, 40) | rectangle(100, 100, 5, 5)
    (found,) = DetectionRules().apply((thing(mask, score=0.75),))
    np.testing.assert_array_equal(found.mask, rectangle(20, 20, 40, 40))
    np.testing.assert_array_equal(found.box, [20, 20, 59, 59])
    assert found.score == 0.75


def test_a_table_behind_the_leg_of_a_chair_keeps_both_halves() -> None:
    mask = rectangle(20, 20, 40, 40) | rectangle(64, 20, 20, 40)
    detection = thing(mask)
    (found,) = DetectionRules().apply((detection,))
    assert found is detection  # nothing changed, nor did the box


def test_what_is_smaller_than_the_limit_is_no_object() -> None:
    assert DetectionRules().apply((thing(rectangle(5, 5, 8, 7)),)) == ()
    assert len(DetectionRules().apply((thing(rectangle(5, 5, 8, 8)),))) == 1


def test_the_wall_beside_a_chair_does_not_say_where_the_chair_is() -> None:
    depth = np.full((HEIGHT, WIDTH), 4.0, dtype=np.float32)
    depth[20:80, 20:60] = 2.0
    depth[30:34, 30:34] = np.nan  # pixels without depth stay
    mask = rectangle(20, 20, 52, 60)
    np.testing.assert_array_equal(at_one_depth(mask, depth, 0.1), rectangle(20, 20, 40, 60))
    camera = Camera(WIDTH, HEIGHT, 130.0, 130.0, 79.5, 59.5)
    clean = object_geometry(camera, depth, thing(mask), depth_gap=0.1)
    exact = object_geometry(camera, depth, thing(rectangle(20, 20, 40, 60)))
    sloppy = object_geometry(camera, depth, thing(mask))
    assert clean.pixel_area == mask.sum()  # the mask stays
    assert np.abs(clean.centroid - exact.centroid).max() < 0.03
    assert clean.extent[2] == 0
    assert sloppy.extent[2] == pytest.approx(2)


def test_a_long_table_is_at_one_depth() -> None:
    depth = np.broadcast_to(np.linspace(6, 1, HEIGHT, dtype=np.float32)[:, None], (HEIGHT, WIDTH)).copy()
    mask = rectangle(20, 5, 100, 110)
    lost = mask & ~at_one_depth(mask, depth, 0.1)
    assert lost.sum() == 0
    half = depth.copy()
    half[::2] = np.nan
    half[:100] = np.nan
    np.testing.assert_array_equal(at_one_depth(mask, half, 0.1), mask)  # too little depth to tell


def test_only_the_classes_asked_for_and_the_dynamic_ones() -> None:
    things = [thing(rectangle(10, 10, 30, 30), "cup"), thing(rectangle(60, 10, 30, 30), "zebra")]
    things.append(thing(rectangle(60, 60, 30, 30), "person"))
    rules = rules_of(Settings(classes="indoor", dynamic="person"), Fake())
    assert {d.category for d in rules.apply(things)} == {"cup", "person"}
    assert rules.classes == INDOOR
    assert {d.category for d in DetectionRules().apply(things)} == {"cup", "zebra", "person"}


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"classes": "chiar"}, r"--classes chiar \(SEMDB_CLASSES\): fake knows only airplane, apple, .*zebra"),
        ({"dynamic": "people"}, r"--dynamic people \(SEMDB_DYNAMIC\)"),
        ({"classes": " , "}, "names no class"),
    ],
)
def test_unknown_classes_are_errors(setting: dict[str, str], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        rules_of(Settings(**setting), Fake())  # type: ignore[arg-type]


def test_rules_are_part_of_the_provenance_and_queries_adopt_them() -> None:
    plain = Describer(Fake(), load_encoder("gist", Settings()), load_features("surf", Settings()), DetectionRules())
    assert json.loads(plain.models[0].config) == {
        "score_threshold": 0.5,
        "part_share": 0.3,
        "min_pixels": 64,
        "depth_gap": 0.1,
        "duplicate_iou": 0.7,
        "rival_share": 0.8,
        "contained": 0.85,
    }
    made = rules_of(Settings(classes="cup,chair", dynamic="person,cat"), Fake())
    info = made.info(Fake().info)
    config = json.loads(info.config)
    assert (config["classes"], config["dynamic"]) == (["chair", "cup"], ["cat", "person"])
    assert info != plain.models[0]
    adopted = rules_of(settings_of_map(Settings(), [info]), Fake())
    assert adopted.info(Fake().info) == info
    other = rules_of(settings_of_map(Settings(classes="all", dynamic="none"), [info]), Fake())
    assert other.info(Fake().info) == plain.models[0]


def test_masks_of_a_recording_are_taken_as_they_are() -> None:
    rules = rules_of(Settings(), RecordedDetector())
    speck = thing(rectangle(20, 20, 40, 40) | rectangle(100, 100, 5, 5))
    assert rules.apply((speck,)) == (speck,)
    assert rules.info(RecordedDetector().info) == RecordedDetector().info


class Everywhere:
    """A feature on every tenth pixel that the mask admits."""

    info = ModelInfo("features", "grid", "")

    def extract(self, grey: ImageArray, mask: np.ndarray | None = None) -> Features:
        v, u = (grid.ravel() for grid in np.mgrid[5 : grey.shape[0] : 10, 5 : grey.shape[1] : 10])
        if mask is not None:
            v, u = v[mask[v, u]], u[mask[v, u]]
        one = np.ones(len(u), dtype=np.float32)
        xy = np.column_stack([u, v]).astype(np.float32)
        return Features(xy, one, one, one, np.zeros(len(u), np.int8), np.ones((len(u), 4), np.float32))


def test_no_feature_lies_on_a_dynamic_object_nor_does_it_count() -> None:
    person, chair = thing(rectangle(40, 20, 40, 90), "person"), thing(rectangle(100, 20, 40, 60), "chair")
    camera = Camera(WIDTH, HEIGHT, 130.0, 130.0, 79.5, 59.5)
    image = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)

    def describe(dynamic: tuple[str, ...]) -> tuple[np.ndarray, dict[str, int], int]:
        rules = DetectionRules(dynamic=dynamic)
        describer = Describer(Fake(person, chair), load_encoder("gist", Settings()), Everywhere(), rules)
        found = describer.describe(image, None, camera)
        xy = found.keypoints.features.xy.astype(int)
        return person.mask[xy[:, 1], xy[:, 0]], found.category_counts, len(found.detections)

    on_person, counts, objects = describe(("person",))
    assert not on_person.any()
    assert counts == {"chair": 1}  # what a place is compared by
    assert objects == 2  # the row is there all the same
    on_person, counts, _ = describe(())
    assert on_person.sum() == 36
    assert counts == {"person": 1, "chair": 1}


def test_mask_rules_are_what_the_documentation_says() -> None:
    assert MaskRules() == MaskRules(0.3, 64, 0.1, 0.7, 0.8, 0.85)


def test_the_box_about_a_mask_is_that_of_opencv() -> None:
    generator = np.random.default_rng(3)
    for share in (0, 0.002, 0.02, 0.9):
        for height, width in ((1, 1), (7, 640), (33, 5), (48, 64)):
            mask = generator.random((height, width)) < share
            assert bounding_box(mask) == cv2.boundingRect(mask.view(np.uint8)), (share, height, width)
    assert bounding_box(rectangle(10, 20, 30, 40)[::2, ::2]) == (5, 10, 15, 20)  # not contiguous
