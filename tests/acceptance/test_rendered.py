"""The main job on a rendered room of full size: what `make demo` shows, as numbers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semdb.geometry import pose_error, pose_from, rotation_from_quat_wxyz
from semdb.recordings import open_recording
from semdb.recordings.synthetic import SyntheticOptions
from tests.rooms import render, semdb, semdb_json


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render(tmp_path_factory.mktemp("rendered") / "room", SyntheticOptions(frames=40, lap_frames=60))


@pytest.fixture(scope="module")
def results(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Method -> result, all on the same 16 keyframes and 24 queries, with no model file and no setting."""
    folder = tmp_path_factory.mktemp("evaluation")
    done = semdb(
        *("evaluate", recording, "--keyframes", 16, "--max-queries", 24, "--json", folder / "e.json"),
        *("--method", "semdb", "--method", "cnn", "--method", "sift-reference"),
        url=f"sqlite:///{folder / 'unused.sqlite3'}",
    )
    assert done.returncode == 0, done.stderr
    assert "recorded" in done.stderr or "masks" in done.stderr  # what nobody asked for by name is said
    return {result["method"]: result for result in json.loads((folder / "e.json").read_text())}


def test_synthetic_bars(results: dict[str, Any]) -> None:
    semantic = results["semdb"]
    assert (semantic["keyframes"], semantic["queries"]) == (16, 24)
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
        *("evaluate", recording, "--keyframes", 16, "--max-queries", 24, "--query-depth"),
        *("--json", tmp_path / "e.json"),
        url=f"sqlite:///{tmp_path / 'unused.sqlite3'}",
    )
    assert done.returncode == 0, done.stderr
    deep = json.loads((tmp_path / "e.json").read_text())
    assert deep["success_rate"] >= results["semdb"]["success_rate"]
    assert deep["mean_translation_m"] < results["semdb"]["mean_translation_m"]


@pytest.fixture(scope="module")
def first_visit(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A database with a map of 20 keyframes of a noisy recording of a whole room."""
    folder = tmp_path_factory.mktemp("visits")
    recording = render(folder / "first", SyntheticOptions(frames=20, lap_frames=20, noise=True))
    url = f"sqlite:///{folder / 'semdb.sqlite3'}"
    done = semdb("ingest", recording, "--map", "room", "--keyframes", 20, url=url)
    assert done.returncode == 0, done.stderr
    return url


def localize(recording: Path, url: str) -> list[dict[str, Any]]:
    images = sorted((recording / "rgb").iterdir())
    found = semdb_json("localize", *images, "--map", "room", "--json", "--coarse", "index", url=url)
    assert isinstance(found, list)
    return found


def test_a_second_visit_with_moved_objects_other_light_and_blur(first_visit: str, tmp_path: Path) -> None:
    # each exposure smears over 2.4 degrees, so that not every image can be localized; none may be wrongly so
    # most poses are right all the same, and are given as ambiguous
    options = SyntheticOptions(frames=15, lap_frames=15, seed=5, second_visit=True, lighting=0.6, blur=0.1, noise=True)
    recording = render(tmp_path / "second", options)
    truth = {entry.image_path.name: entry.world_from_camera for entry in open_recording(recording).entries}
    answers = localize(recording, first_visit)
    errors: dict[str, list[tuple[float, float]]] = {"localized": [], "ambiguous": [], "failed": []}
    for answer in answers:
        if answer["verdict"] != "failed":
            pose = pose_from(rotation_from_quat_wxyz(answer["pose"]["quat_wxyz"]), answer["pose"]["position"])
            true_pose = truth[Path(answer["image"]).name]
            assert true_pose is not None
            errors[answer["verdict"]].append(pose_error(pose, true_pose))
    assert len(errors["localized"]) >= 0.25 * len(answers)
    assert sum(metres > 0.25 or degrees > 5 for metres, degrees in errors["localized"]) == 0
    assert np.median([metres for metres, _ in errors["localized"]]) < 0.04
    given = errors["localized"] + errors["ambiguous"]
    assert sum(metres <= 0.25 and degrees <= 5 for metres, degrees in given) >= 0.8 * len(answers)


def test_another_room_is_failed_not_found(first_visit: str, tmp_path: Path) -> None:
    recording = render(tmp_path / "other", SyntheticOptions(frames=20, lap_frames=20, room_seed=7, noise=True))
    verdicts = [answer["verdict"] for answer in localize(recording, first_visit)]
    assert len(verdicts) == 20
    assert verdicts.count("localized") == 0
    assert verdicts.count("failed") >= 17
