"""The main job on a rendered room of full size: what `make demo` shows, as numbers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from semdb.recordings.synthetic import SyntheticOptions
from tests.rooms import render, semdb


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render(tmp_path_factory.mktemp("rendered") / "room", SyntheticOptions(frames=80))


@pytest.fixture(scope="module")
def results(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Method -> result, all on the same 16 keyframes and 40 queries, with no model file and no setting."""
    folder = tmp_path_factory.mktemp("evaluation")
    done = semdb(
        *("evaluate", recording, "--keyframes", 16, "--max-queries", 40, "--json", folder / "e.json"),
        *("--method", "semdb", "--method", "cnn", "--method", "sift-reference", "--method", "paper"),
        url=f"sqlite:///{folder / 'unused.sqlite3'}",
    )
    assert done.returncode == 0, done.stderr
    assert "recorded" in done.stderr or "masks" in done.stderr  # what nobody asked for by name is said
    return {result["method"]: result for result in json.loads((folder / "e.json").read_text())}


def test_synthetic_bars(results: dict[str, Any]) -> None:
    semantic = results["semdb"]
    assert (semantic["keyframes"], semantic["queries"]) == (16, 40)
    assert semantic["success_rate"] >= 0.98
    assert semantic["false_localizations"] == 0
    assert semantic["median_translation_m"] <= 0.002
    assert semantic["median_rotation_deg"] <= 0.05


def test_semantics_rank_less_and_lose_nothing(results: dict[str, Any]) -> None:
    semantic, blind = results["semdb"], results["cnn"]
    assert semantic["success_rate"] >= blind["success_rate"]
    assert semantic["recall"]["5cm_5deg"] >= blind["recall"]["5cm_5deg"]
    assert semantic["ranked_share"] <= 0.6 < blind["ranked_share"]


def test_as_many_within_5_cm_as_the_reference_that_knows_the_right_keyframes(results: dict[str, Any]) -> None:
    semantic, reference = results["semdb"], results["sift-reference"]
    assert semantic["recall"]["5cm_5deg"] >= reference["recall"]["5cm_5deg"]
    assert semantic["success_rate"] >= reference["success_rate"]


def test_query_depth_is_better_again(recording: Path, results: dict[str, Any], tmp_path: Path) -> None:
    done = semdb(
        *("evaluate", recording, "--keyframes", 16, "--max-queries", 40, "--query-depth"),
        *("--json", tmp_path / "e.json"),
        url=f"sqlite:///{tmp_path / 'unused.sqlite3'}",
    )
    assert done.returncode == 0, done.stderr
    deep = json.loads((tmp_path / "e.json").read_text())
    assert deep["success_rate"] >= results["semdb"]["success_rate"]
    assert deep["mean_translation_m"] < results["semdb"]["mean_translation_m"]
