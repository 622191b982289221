"""``make test-train``: a small Mask R-CNN learns furniture from rendered rooms, starting from random weights.

Not part of ``make test``: it takes 13 minutes of processor time, on two cores.
"""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.rooms import COMMAND, environment

SIZE = ("--width", 256, "--height", 192)
CLASSES = "chair,couch,dining table,tv"
RECIPE = (
    *("--weights", "none", "--backbone", "resnet18", "--channels", 64, "--anchor", 12),
    *("--min-size", 144, "--max-size", 192, "--batch", 4, "--rois", 32),
    *("--epochs", "0,0,14", "--rates", "0.001,0.001,0.001", "--optimizer", "adamw", "--decay"),
)


def run(*arguments: object, folder: Path) -> None:
    """Runs ``semdb ARGUMENTS`` and shows what it says; progress too."""
    settings = environment(f"sqlite:///{folder}/unused", SEMDB_THREADS="2", SEMDB_DEVICE="auto")
    subprocess.run([*COMMAND, *map(str, arguments)], env=settings, timeout=3000, check=True)


@pytest.fixture(scope="module")
def scores(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Scores on other views of the rooms, and on rooms that were never seen."""
    folder = tmp_path_factory.mktemp("training")
    coco, trained = folder / "coco", folder / "trained"
    for split, rooms, frames, seed, room_seed in (
        ("train", 12, 24, 0, 100),
        ("val", 12, 8, 5, 100),
        ("other", 8, 8, 0, 900),
    ):
        numbers = ("--rooms", rooms, "--frames", frames, "--seed", seed, "--room-seed", room_seed)
        run("synth", coco, "--coco", "--split", split, *numbers, *SIZE, folder=folder)
    run("train", "detector", "--coco", coco, "--output", trained, "--classes", CLASSES, *RECIPE, folder=folder)
    found = {}
    for split in ("val", "other"):
        file = folder / f"{split}.json"
        data = ("--coco", coco, "--split", split, "--classes", CLASSES, "--json", file)
        run("evaluate-detector", f"torchvision:{trained}/detector.pth", *data, folder=folder)
        found[split] = json.loads(file.read_text())
    return found


def test_it_finds_furniture_in_views_it_has_not_seen(scores: dict[str, Any]) -> None:
    assert scores["val"]["boxes"]["ap50"] > 0.5


def test_masks_are_learnt_too(scores: dict[str, Any]) -> None:
    assert scores["val"]["masks"]["ap50"] > 0.35


def test_it_finds_furniture_in_rooms_it_has_not_seen(scores: dict[str, Any]) -> None:
    assert scores["other"]["boxes"]["ap50"] > 0.5
