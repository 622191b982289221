"""Metrics by hand-computed cases; JSON and CSV forms."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from semdb.errors import UsageError
from semdb.evaluation.files import to_json, write_json, write_queries_csv
from semdb.evaluation.metrics import (
    TIMING_STAGES,
    EvaluationResult,
    QueryResult,
    query_result,
    summarise,
    with_other_truth,
    with_reach,
)
from semdb.evaluation.retrieval import Retrieval, near_keyframes, reach
from semdb.geometry import pose_from, so3_exp
from semdb.types import Candidate, FloatArray, Localization, ModelInfo, Verdict

MODELS = (ModelInfo("detector", "recorded", ""), ModelInfo("features", "sift", "ab12", '{"nfeatures":1500}'))


def query(
    translation: float | None,
    rotation: float | None,
    verdict: Verdict = Verdict.LOCALIZED,
    *,
    stage: str = "filtered",
    total_ms: float = 10.0,
    share: float | None = 0.2,
    matched: int = 3,
) -> QueryResult:
    return QueryResult(
        "rgb/1.png", 1, verdict, translation, rotation, 4, 50, 0.9, stage, share, matched, {"total": total_ms}, "why"
    )


def summary(queries: list[QueryResult]) -> EvaluationResult:
    return summarise(
        queries, recording="room", protocol="paper", method="semdb", models=MODELS, frames=100, keyframes=10
    )


CASE = [
    query(0.01, 0.5, total_ms=10, share=0.1, matched=1),
    query(0.04, 6.0, total_ms=20, share=0.2, matched=2, stage="soft"),  # false: rotation
    query(0.20, 1.5, total_ms=30, share=0.3, matched=3, stage="all"),
    query(0.40, 0.1, total_ms=40, share=1.0, matched=8, stage="all"),  # false: translation
    query(0.01, 0.1, Verdict.AMBIGUOUS, total_ms=50, share=1.0, matched=8, stage="all"),
    query(None, None, Verdict.FAILED, total_ms=60, share=1.0, matched=8, stage="all"),
]


def test_summary_by_hand() -> None:
    result = summary(CASE)
    assert (result.queries, result.localized, result.false_localizations) == (6, 4, 2)
    assert result.success_rate == pytest.approx(4 / 6)
    assert result.median_translation_m == pytest.approx(0.12)
    assert result.median_rotation_deg == pytest.approx(1.0)
    assert result.mean_translation_m == pytest.approx(0.1625)
    assert result.mean_rotation_deg == pytest.approx(2.025)
    assert result.ranked_share == pytest.approx(0.65)
    assert result.keyframes_matched == pytest.approx(5.5)
    assert result.stages == {"filtered": 1, "soft": 1, "all": 4}


def test_recalls_are_over_all_queries_and_only_localized_ones_count() -> None:
    recall = summary(CASE).recall
    assert recall == {
        "5cm_5deg": pytest.approx(1 / 6),
        "0.25m_2deg": pytest.approx(2 / 6),
        "0.3m": pytest.approx(3 / 6),
        "2.5deg": pytest.approx(3 / 6),
    }


def test_limits_themselves_are_within() -> None:
    assert query(0.25, 5.0).is_false is False
    assert query(0.2501, 0.0).is_false is True
    assert query(0.05, 5.0).is_within(0.05, 5.0) is True
    assert query(9.0, 90.0, Verdict.AMBIGUOUS).is_false is False


def test_timing_percentiles_and_stages_that_nobody_ran() -> None:
    timing = summary(CASE).timing_ms
    assert timing["total"] == {"p50": pytest.approx(35.0), "p95": pytest.approx(57.5)}
    assert tuple(timing) == TIMING_STAGES
    assert timing["detect"] == {"p50": None, "p95": None}


def test_nothing_localized_and_no_query_give_none() -> None:
    failed = summary([query(None, None, Verdict.FAILED)])
    assert failed.success_rate == 0.0
    assert failed.median_translation_m is None
    assert failed.mean_rotation_deg is None
    assert failed.recall["5cm_5deg"] == 0.0
    empty = summary([])
    assert (empty.queries, empty.success_rate, empty.ranked_share) == (0, None, None)
    assert set(empty.recall.values()) == {None}
    json.dumps(to_json(empty), allow_nan=False)


def test_json_has_exactly_the_contract_keys_and_no_nan() -> None:
    nan = float("nan")
    odd = QueryResult("a", 0, Verdict.FAILED, nan, nan, None, 0, nan, "all", nan, 0, {"total": nan})
    document = to_json(summary([*CASE, odd]))
    assert set(document) == {
        "recording", "protocol", "method", "models", "frames", "keyframes", "queries", "localized",
        "false_localizations", "success_rate", "median_translation_m", "median_rotation_deg", "mean_translation_m",
        "mean_rotation_deg", "recall", "ranked_share", "keyframes_matched", "stages", "timing_ms", "per_query",
        "training_frames",
        "sequence", "keyframes_asked", "query_depth", "map_recordings", "query_recordings", "retrieval", "truth",
        "coarse", "other_errors", "disagreement", "nees",
    }  # fmt: skip
    assert set(document["per_query"][0]) == {
        "frame", "frame_index", "verdict", "translation_m", "rotation_deg", "candidate", "inliers", "confidence",
        "stage", "ranked_share", "keyframes_matched", "timing_ms", "reason", "recording", "timestamp_ns",
        "candidate_recording", "keyframe_in_reach", "retrieval_rank", "nearest_keyframe_m", "nearest_keyframe_deg",
        "sharpness", "other_translation_m", "other_rotation_deg", "nees_position", "nees_rotation",
    }  # fmt: skip
    assert document["models"]["features"] == {"name": "sift", "sha256": "ab12", "config": {"nfeatures": 1500}}
    assert document["per_query"][0]["verdict"] == "localized"
    assert document["per_query"][-1]["confidence"] is None
    assert document["per_query"][-1]["timing_ms"] == {"total": None}
    assert json.loads(json.dumps(document, allow_nan=False)) == document


def test_one_result_is_an_object_and_several_are_a_list(tmp_path: Path) -> None:
    write_json(tmp_path / "one.json", [summary(CASE)])
    write_json(tmp_path / "two.json", [summary(CASE), summary([])])
    assert json.loads((tmp_path / "one.json").read_text())["localized"] == 4
    assert [item["queries"] for item in json.loads((tmp_path / "two.json").read_text())] == [6, 0]
    write_json(tmp_path / "first.json", [summary(CASE)], several=True)
    assert [item["queries"] for item in json.loads((tmp_path / "first.json").read_text())] == [6]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["first.json", "one.json", "two.json"]


def test_csv_of_queries(tmp_path: Path) -> None:
    write_queries_csv(tmp_path / "q.csv", [summary(CASE)])
    with (tmp_path / "q.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6
    assert (rows[1]["recording"], rows[1]["keyframes"], rows[1]["stage"]) == ("room", "10", "soft")
    assert (float(rows[1]["rotation_deg"]), float(rows[1]["total_ms"])) == (6.0, 20.0)
    assert (rows[5]["verdict"], rows[5]["translation_m"]) == ("failed", "")
    assert (rows[5]["keyframes_matched"], rows[5]["reason"]) == ("8", "why")


def test_files_that_cannot_be_written_are_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"cannot be written to .*missing"):
        write_json(tmp_path / "missing" / "r.json", [summary(CASE)])
    with pytest.raises(UsageError, match=r"cannot be written to .*missing"):
        write_queries_csv(tmp_path / "missing" / "q.csv", [summary(CASE)])


def test_query_result_of_a_localization() -> None:
    truth = pose_from(np.eye(3), [1.0, 0.0, 0.0])
    estimate = pose_from(so3_exp([0.0, np.radians(3.0), 0.0]), [1.0, 0.3, 0.4])
    candidates = (Candidate(7, "room", 70, 0.5, 0.9, 12), Candidate(8, "room", 80, 0.5, 0.8, 40))
    answer = Localization(
        Verdict.LOCALIZED, "m", estimate, None, float("nan"), 52, "soft", candidates, 0.3, 2, "ok", {"match": 2.0}
    )
    result = query_result("f", 5, answer, truth, timing_ms={"decode": 1.0})
    assert result.translation_m == pytest.approx(0.5)
    assert result.rotation_deg == pytest.approx(3.0)
    assert (result.candidate, result.inliers, result.confidence) == (80, 52, None)
    assert result.timing_ms == {"match": 2.0, "decode": 1.0}


def test_query_result_without_pose_or_truth() -> None:
    failed = Localization(Verdict.FAILED, "m", None, None, 0.0, 3, "all", (), 1.0, 5, "too few", {})
    result = query_result("f", 5, failed, np.eye(4))
    assert (result.translation_m, result.candidate, result.is_false) == (None, None, False)
    found = Localization(Verdict.LOCALIZED, "m", np.eye(4), None, 0.9, 30, "all", (), 1.0, 5, "", {})
    assert query_result("f", 5, found, None).rotation_deg is None


def at(x: float, degrees: float = 0.0) -> FloatArray:
    return pose_from(so3_exp([0.0, np.radians(degrees), 0.0]), [x, 0.0, 0.0])


def test_a_keyframe_sees_the_place_within_0_3_m_and_20_degrees() -> None:
    poses = np.stack([at(0.29, 19), at(0.31), at(0.0, 21), at(0.1)])
    assert near_keyframes(at(0), poses).tolist() == [True, False, False, True]
    found = reach(at(0), poses, [1, 2, 3, 0])
    assert (found.reachable, found.rank) == (True, 3)
    assert (found.nearest_translation_m, found.nearest_rotation_deg) == pytest.approx((0.1, 0.0), abs=1e-6)
    assert reach(at(0), poses, [1, 2]).rank is None
    assert reach(at(0), poses, [1] * 10 + [3]).rank is None  # only the first ten count
    assert reach(at(5), poses, [0, 1, 2, 3]).reachable is False
    assert reach(at(0), poses, None).rank is None


def test_retrieval_counts_only_queries_with_a_keyframe_in_reach() -> None:
    poses = np.stack([at(0), at(1), at(2)])
    orders = {0.0: [0, 1, 2], 1.0: [2, 1, 0], 2.0: [1, 0], 9.0: [0, 1, 2]}
    queries = [with_reach(query(0.01, 0.1), reach(at(x), poses, order), retrieves=True) for x, order in orders.items()]
    assert [item.retrieval_rank for item in queries] == [1, 2, None, None]
    assert [item.keyframe_in_reach for item in queries] == [True, True, True, False]
    assert summary(queries).retrieval == Retrieval(3, pytest.approx(1 / 3), pytest.approx(2 / 3), pytest.approx(2 / 3))
    told = with_reach(query(0.01, 0.1), reach(at(0), poses, None), retrieves=False)
    assert summary([told]).retrieval is None
    assert to_json(summary(queries))["retrieval"]["queries"] == 3


def test_errors_against_the_other_truth() -> None:
    answer = Localization(Verdict.LOCALIZED, "m", at(1.0), None, 0.9, 30, "all", (), 1.0, 5, "", {})
    given = query_result("f", 5, answer, at(1.04))
    both = with_other_truth(given, at(0.7, 1.0))
    assert (both.translation_m, both.other_translation_m) == pytest.approx((0.04, 0.3))
    assert both.other_rotation_deg == pytest.approx(1.0)
    result = summary([both, query(None, None, Verdict.FAILED)])
    assert result.recall["5cm_5deg"] == 0.5
    assert result.other_errors is not None
    assert result.other_errors.median_translation_m == pytest.approx(0.3)
    assert result.other_errors.recall["5cm_5deg"] == 0.0
    assert result.other_errors.false_localizations == 1
    assert with_other_truth(given, None) == given
    assert summary([given]).other_errors is None


def test_a_right_pose_whatever_the_verdict() -> None:
    assert query(0.25, 5.0, Verdict.AMBIGUOUS).has_right_pose is True
    assert query(0.26, 0.0).has_right_pose is False
    assert query(None, None, Verdict.FAILED).has_right_pose is False
