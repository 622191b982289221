"""Learned features, and the networks that match them."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path

import cv2
import numpy as np
import pytest

from semdb.cli.doctor import learned
from semdb.errors import ModelError, UsageError
from semdb.localization.alike import Alike, LearnedVerdictOptions, weigh_learned
from semdb.localization.confidence import Evidence as PoseEvidence
from semdb.localization.images import fallback_of
from semdb.localization.learned_matching import for_learned, is_learned, match_by
from semdb.localization.localizer_options import LocalizerOptions
from semdb.localization.matching import Evidence, MatchingOptions, match_keypoints
from semdb.localization.verdict import Judgement
from semdb.localization.views import ClassNumbers, View, make_view
from semdb.perception.features import load_features
from semdb.perception.matchers import OnnxMatcher, load_matcher
from semdb.settings import Settings
from semdb.types import Camera, Features, Keypoints, ModelInfo, Verdict
from tests.unit.onnx_files import write_constant_model

SETTINGS = Settings(threads=1, device="cpu")
GREY = np.full((48, 64), 90, np.uint8)
XY = np.array([[3, 4], [10.5, 20], [63, 47]], np.float32)
SCORES = np.array([0.2, 0.9, 0.5], np.float32)
DESCRIPTORS = np.array([[2, 0, 0, 0, 0], [0, 3, 4, 0, 0], [0, 0, 0, 0, 0.1]], np.float32)


def write(path: Path, **changed: np.ndarray) -> str:
    return (
        f"onnx:{write_constant_model(path, {'keypoints': XY, 'scores': SCORES, 'descriptors': DESCRIPTORS} | changed)}"
    )


def test_keypoints_come_by_score_with_unit_descriptors_of_any_width(tmp_path: Path) -> None:
    extractor = load_features(write(tmp_path / "five.onnx"), SETTINGS)
    found = extractor.extract(GREY)
    np.testing.assert_allclose(found.xy, XY[[1, 2, 0]])
    np.testing.assert_allclose(found.response, [0.9, 0.5, 0.2])
    np.testing.assert_allclose(found.descriptors, [[0, 0.6, 0.8, 0, 0], [0, 0, 0, 0, 1], [1, 0, 0, 0, 0]], atol=1e-6)
    assert found.descriptors.dtype == np.float32
    assert extractor.info.name == "onnx:five.onnx"
    assert len(extractor.info.sha256) == 64
    assert json.loads(extractor.info.config) == {"max_keypoints": 1500, "size_px": 16.0}
    assert is_learned([extractor.info])


def test_a_mask_and_the_greatest_number_hold(tmp_path: Path) -> None:
    spec = write(tmp_path / "five.onnx")
    mask = np.ones(GREY.shape, np.bool_)
    mask[20, 10] = False  # 10.5 is rounded to even
    np.testing.assert_allclose(load_features(spec, SETTINGS).extract(GREY, mask).xy, XY[[2, 0]])
    many = {
        "keypoints": np.tile(XY, (40, 1)),
        "scores": np.tile(SCORES, 40),
        "descriptors": np.tile(DESCRIPTORS, (40, 1)),
    }
    few = Settings(threads=1, max_keypoints=50)
    assert len(load_features(write(tmp_path / "many.onnx", **many), few).extract(GREY)) == 50


def test_an_image_without_pixels_has_no_keypoints(tmp_path: Path) -> None:
    found = load_features(write(tmp_path / "five.onnx"), SETTINGS).extract(np.zeros((0, 0), np.uint8))
    assert found.descriptors.shape == (0, 5)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"keypoints": np.zeros((2, 2), np.float32)}, r"wanted are \[N, 2\], \[N\] and \[N, d\]"),
        ({"keypoints": np.zeros((3, 3), np.float32)}, r"wanted are \[N, 2\]"),
        ({"descriptors": np.zeros((3,), np.float32)}, r"gave descriptors \(3,\)"),
        ({"descriptors": np.full((3, 4), np.nan, np.float32)}, "not finite"),
        ({"scores": np.full(3, np.inf, np.float32)}, "not finite"),
        ({"keypoints": np.array(1, np.float32)}, r"gave keypoints \(\), scores \(3,\)"),
    ],
)
def test_a_network_that_gives_nonsense_is_an_error(
    tmp_path: Path, changed: dict[str, np.ndarray], message: str
) -> None:
    with pytest.raises(ModelError, match=message):
        load_features(write(tmp_path / "bad.onnx", **changed), SETTINGS).extract(GREY)


def test_another_network_is_no_feature(tmp_path: Path) -> None:
    path = write_constant_model(tmp_path / "other.onnx", {"embedding": np.ones((1, 4), np.float32)})
    with pytest.raises(ModelError, match="has no output keypoints, scores, descriptors"):
        load_features(f"onnx:{path}", SETTINGS)
    with pytest.raises(ModelError, match="no model file"):
        load_features("onnx:nowhere.onnx", SETTINGS)
    with pytest.raises(ModelError, match="is no matcher: wanted are float inputs keypoints0"):
        load_matcher(f"onnx:{path}", SETTINGS)
    with pytest.raises(UsageError, match="SEMDB_MATCHER is onnx:FILE"):
        load_matcher("lighterglue", SETTINGS)


@pytest.mark.parametrize(
    "found", [np.zeros(0, np.int64), np.zeros((2, 2), np.int64), np.array([0, 3]), np.array([0.0, 1.0])]
)
def test_matches_that_are_none_are_an_error(tmp_path: Path, found: np.ndarray) -> None:
    matcher = OnnxMatcher.__new__(OnnxMatcher)
    matcher.path = tmp_path / "matcher.onnx"
    with pytest.raises(ModelError, match=r"matcher.onnx gave matches \(.*for 2 and 3 keypoints; wanted is an integer"):
        matcher._pairs(found, 2, 3)
    one, two = matcher._pairs(np.array([2, -1]), 2, 3)
    assert (one.tolist(), two.tolist()) == ([0], [2])


def test_a_matcher_goes_with_what_it_can_match(tmp_path: Path) -> None:
    surf, learned = ModelInfo("features", "surf", ""), ModelInfo("features", "onnx:x.onnx", "0")
    own = replace_settings(features_fallback="sift", matcher="onnx:matcher.onnx")
    with pytest.raises(UsageError, match="matches learned features, and SEMDB_FEATURES_FALLBACK is sift"):
        fallback_of(own, [surf])
    found = fallback_of(own, [learned])  # of which the matcher is
    assert found is not None
    assert (found.name, found.matcher) == ("sift", None)


def test_doctor_looks_at_matcher_and_fallback() -> None:
    assert list(learned(SETTINGS)) == []
    found = list(learned(replace_settings(features_fallback="sift", matcher="onnx:nowhere.onnx")))
    assert [(one.state, one.what) for one in found] == [("problem", "matcher"), ("ok", "features fallback")]


def replace_settings(**changed: str) -> Settings:
    return SETTINGS.model_copy(update=changed)


def test_thresholds_follow_the_feature() -> None:
    surf = ModelInfo("features", "surf", "")
    assert LocalizerOptions().for_models([surf]) == LocalizerOptions()
    options = LocalizerOptions().for_models([ModelInfo("features", "onnx:x.onnx", "0")])
    assert LocalizerOptions().learned is None
    assert options.learned == LearnedVerdictOptions()
    learned = options.pose.matching
    assert learned == for_learned(MatchingOptions())
    assert learned.ceiling < MatchingOptions().ceiling
    assert for_learned(MatchingOptions(evidence=Evidence.OBJECTS)).evidence is Evidence.OBJECTS


@pytest.mark.parametrize(
    ("alike", "likeness", "verdict", "confidence"),
    [
        (Alike(0.81, 0.48), 0.5, Verdict.LOCALIZED, 0.97),
        (Alike(0.79, 0.9), 0.9, Verdict.AMBIGUOUS, 0.5),  # shapes agree, what is on them does not
        (Alike(0.81, 0.9), 0.45, Verdict.AMBIGUOUS, 0.5),
        (Alike(0.95, 0.46), 0.9, Verdict.AMBIGUOUS, 0.5),  # a thing is there, the rest is another place
        (None, 0.1, Verdict.LOCALIZED, 0.97),  # a keyframe without depth
    ],
)
def test_what_is_learned_counts_where_the_query_looks_alike(
    alike: Alike | None, likeness: float, verdict: Verdict, confidence: float
) -> None:
    numbers = {field.name: 1 for field in fields(PoseEvidence)} | {"likeness": likeness}
    evidence = PoseEvidence(**numbers)
    sure = Judgement(Verdict.LOCALIZED, 0.97, "so many agree")
    found = weigh_learned(sure, evidence, alike, LearnedVerdictOptions())
    assert (found.verdict, found.confidence) == (verdict, confidence)
    doubt = Judgement(Verdict.AMBIGUOUS, 0.4, "in doubt")
    assert weigh_learned(doubt, evidence, alike, LearnedVerdictOptions()) == doubt


def test_a_ceiling_refuses_what_is_nearest_but_unlike() -> None:
    query = np.eye(3, dtype=np.float32)
    keyframe = np.array([[0.9, 0, np.sqrt(0.19)], [0, 0.6, 0.8]], np.float32)
    classes = np.full(3, -1, np.int32)
    all_pairs = match_keypoints(query, keyframe, classes, classes[:2], MatchingOptions(ratio=1.0))
    near = match_keypoints(query, keyframe, classes, classes[:2], MatchingOptions(ratio=1.0, ceiling=0.36))
    assert list(zip(all_pairs.query, all_pairs.keyframe, strict=True)) == [(0, 0), (2, 1)]
    assert list(zip(near.query, near.keyframe, strict=True)) == [(0, 0)]


def view_of(features: Features, objects: list[int], numbers: ClassNumbers, camera: Camera) -> View:
    points = np.zeros((len(features), 3), np.float32)
    return make_view(camera, Keypoints(features, np.array(objects, np.int32), points), ["cup"], numbers)


def test_what_a_matcher_pairs_becomes_matches(tmp_path: Path) -> None:
    class Crossed:
        def match(self, *given: object) -> tuple[np.ndarray, np.ndarray]:
            self.given = given
            return np.array([0, 2], np.int32), np.array([1, 0], np.int32)

    found = load_features(write(tmp_path / "five.onnx"), SETTINGS).extract(GREY)
    camera, numbers = Camera(64, 48, 50, 50, 32, 24), ClassNumbers()
    matcher = Crossed()
    query = view_of(found, [0, -1, -1], numbers, camera)
    keyframe = view_of(found, [-1, 0, -1], numbers, camera)
    matches = match_by(matcher, query, keyframe, MatchingOptions())
    assert matches.same_class.tolist() == [True, False]
    np.testing.assert_allclose(matches.distance, [2, 2], atol=1e-6)
    assert matcher.given[2] == (64, 48)
    on_objects = match_by(matcher, query, keyframe, MatchingOptions(evidence=Evidence.OBJECTS))
    assert on_objects.query.tolist() == [0]


def test_the_real_networks_find_a_shifted_image_again(shared_dir: Path) -> None:
    image = cv2.imread(str(shared_dir / "recordings/7scenes_redkitchen/seq-01/frame-000000.color.jpg"), 0)
    assert image is not None
    settings = Settings(threads=1, device="cpu", max_keypoints=400)
    extractor = load_features(f"onnx:{shared_dir / 'models/xfeat_features.onnx'}", settings)
    matcher = load_matcher(f"onnx:{shared_dir / 'models/xfeat_lighterglue.onnx'}", settings)
    assert load_matcher(f"onnx:{shared_dir / 'models/xfeat_lighterglue.onnx'}", settings) is matcher
    one, two = extractor.extract(image[:, :608]), extractor.extract(image[:, 32:])
    assert one.descriptors.shape == (400, 64)
    i, j = matcher.match(one.xy, one.descriptors, (608, 480), two.xy, two.descriptors, (608, 480))
    shift = one.xy[i] - two.xy[j]
    assert len(i) > 250
    assert (np.abs(shift - (32, 0)).max(axis=1) < 2).mean() > 0.95
    assert len(np.unique(j)) == len(j)
    no, _ = matcher.match(one.xy[:1], one.descriptors[:1], (608, 480), two.xy, two.descriptors, (608, 480))
    assert len(no) == 0
    with pytest.raises(UsageError, match="compares descriptors of 64 numbers, this map has float32 of 5"):
        matcher.match(one.xy, one.descriptors[:, :5], (608, 480), two.xy, two.descriptors, (608, 480))
