"""The main job on real recordings with real networks, where they lie beside the checkout."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.rooms import semdb, semdb_json

RED_KITCHEN = "recordings/7scenes_redkitchen"
FREIBURG = "recordings/tum_rgbd_dataset_freiburg1_rpy"
CABINET = "recordings/tum_freiburg3_cabinet"


def networks(shared_dir: Path) -> dict[str, str]:
    models = shared_dir / "models"
    return {
        "SEMDB_DETECTOR": f"onnx:{models / 'mask_rcnn_2go.onnx'}",
        "SEMDB_ENCODER": f"onnx:{models / 'squeezenet_places365.onnx'}",
        "SEMDB_THREADS": "2",
    }


def evaluate(shared_dir: Path, tmp_path: Path, recording: str, url: str, *options: object) -> dict[str, Any]:
    written = tmp_path / "evaluation.json"
    done = semdb(*("evaluate", shared_dir / recording, "--json", written, *options), url=url, **networks(shared_dir))
    assert done.returncode == 0, done.stderr
    result: dict[str, Any] = json.loads(written.read_text())
    return result


@pytest.mark.shared
def test_red_kitchen(shared_dir: Path, tmp_path: Path) -> None:
    result = evaluate(
        *(shared_dir, tmp_path, RED_KITCHEN, f"sqlite:///{tmp_path / 'unused.sqlite3'}"),
        *("--keyframes", 25, "--max-queries", 32),
    )
    assert (result["frames"], result["keyframes"], result["queries"]) == (250, 25, 32)
    assert result["success_rate"] >= 0.97
    assert result["median_translation_m"] <= 0.016
    assert result["median_rotation_deg"] <= 0.7
    assert result["false_localizations"] == 0


@pytest.mark.shared
def test_freiburg1_rpy(shared_dir: Path, tmp_path: Path) -> None:
    result = evaluate(
        *(shared_dir, tmp_path, FREIBURG, f"sqlite:///{tmp_path / 'unused.sqlite3'}"),
        *("--keyframes", 40, "--max-queries", 27),
    )
    assert (result["frames"], result["keyframes"], result["queries"]) == (121, 40, 27)
    assert result["success_rate"] >= 0.93
    assert result["median_translation_m"] <= 0.015
    assert result["median_rotation_deg"] <= 0.95
    assert result["false_localizations"] <= 2


@pytest.mark.shared
def test_depth_localizes_where_texture_is_scarce(shared_dir: Path, tmp_path: Path) -> None:
    """A plain cabinet on a plain floor: keypoints alone find 41 % of it, two of them 16 cm off and sure of it."""
    result = evaluate(
        *(shared_dir, tmp_path, CABINET, f"sqlite:///{tmp_path / 'unused.sqlite3'}"),
        *("--keyframes", 14, "--query-depth"),
    )
    assert (result["frames"], result["keyframes"], result["queries"]) == (58, 14, 44)
    assert result["success_rate"] >= 0.80
    assert result["false_localizations"] == 0
    assert result["recall"]["5cm_5deg"] >= 0.95 * result["success_rate"]
    assert result["median_translation_m"] <= 0.014


@pytest.mark.shared
def test_both_servers_give_equal_figures(shared_dir: Path, tmp_path: Path, mariadb_url: str) -> None:
    one, two = (
        evaluate(shared_dir, tmp_path, FREIBURG, url, "--keyframes", 20, "--max-queries", 8, "--coarse", coarse)
        for url, coarse in ((f"sqlite:///{tmp_path / 'unused.sqlite3'}", "sql"), (mariadb_url, "index"))
    )
    for result in (one, two):
        del result["timing_ms"]
        for query in result["per_query"]:
            del query["timing_ms"]
    assert one == two
    assert one["localized"] >= 7


@pytest.mark.shared
def test_another_kitchen_is_not_found(shared_dir: Path, tmp_path: Path) -> None:
    """Desk images asked of the kitchen: none may be reported as localized."""
    url = f"sqlite:///{tmp_path / 'semdb.sqlite3'}"
    settings = networks(shared_dir)
    done = semdb("ingest", shared_dir / RED_KITCHEN, "--keyframes", 15, "--map", "kitchen", url=url, **settings)
    assert done.returncode == 0, done.stderr
    desk = sorted((shared_dir / FREIBURG / "rgb").iterdir())[::12]
    answers = semdb_json("localize", *desk, "--map", "kitchen", "--json", url=url, **settings)
    assert len(answers) == 11
    verdicts = [answer["verdict"] for answer in answers]
    assert verdicts.count("localized") == 0
    assert verdicts.count("failed") >= 10
    kitchen = sorted((shared_dir / RED_KITCHEN / "seq-01").glob("*.color.jpg"))[2::50]
    found = semdb_json("localize", *kitchen, "--json", url=url, **settings)
    verdicts = [answer["verdict"] for answer in found]
    assert set(verdicts) <= {"localized", "ambiguous"}
    assert verdicts.count("localized") >= 4  # 15 keyframes of a kitchen are few
