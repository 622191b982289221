"""What an evaluation adds to a localization: the times."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import numpy as np

from semdb.evaluation.methods import method_named
from semdb.evaluation.runs import LocalizerRun
from semdb.types import Localization, Verdict


def answer_after(seconds: float) -> Localization:
    time.sleep(seconds)
    return Localization(
        verdict=Verdict.FAILED,
        map_name="room",
        world_from_camera=None,
        covariance=None,
        confidence=0.0,
        inliers=0,
        stage="all",
        candidates=(),
        ranked_share=1.0,
        keyframes_matched=0,
        reason="",
        timing_ms={"filter": 1.0, "rank": 0.0, "match": 0.0, "pose": 0.0},
    )


def test_total_is_the_whole_time_of_a_query() -> None:
    """Also what no stage counts, such as asking the database what has changed."""
    description = SimpleNamespace(timing_ms={"detect": 2.0, "encode": 3.0, "features": 4.0})
    describer: Any = SimpleNamespace(models=(), describe=lambda *_: description)
    cache = SimpleNamespace(poses=lambda: ([1, 2], np.stack([np.eye(4)] * 2)))
    localizer: Any = SimpleNamespace(cache=cache, localize=lambda _: answer_after(0.05))
    frame: Any = SimpleNamespace(
        name="a", index=7, image=np.zeros((4, 4, 3), np.uint8), depth=None, camera=None, instances=None,
        world_from_camera=None, timestamp_ns=5,
    )  # fmt: skip
    run = LocalizerRun(method_named("semdb"), describer, localizer, query_depth=False)
    result, _ = run.answer("room", frame, 10.0, {(id(describer), False): (description, 9.0)})
    assert (result.recording, result.timestamp_ns) == ("room", 5)
    assert result.timing_ms["total"] >= 10 + 9 + 50
    assert set(result.timing_ms) == {
        "decode",
        "detect",
        "encode",
        "features",
        "filter",
        "rank",
        "match",
        "pose",
        "total",
    }
    assert len(run.poses) == 2
