"""Pictures of training data are read as all others are; sets that are strange are named."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from semdb.errors import TrainingError
from semdb.training.coco import load_coco, mask_of, read_marked_picture, read_picture
from semdb.training.evaluation import evaluate_detector
from tests.unit.test_recordings_picture_kinds import with_orientation
from tests.unit.test_training import Perfect, shapes

__all__ = ["shapes"]  # the fixture


def coco_copy(shapes: Path, folder: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """The data of `shapes`, changed, with images of its own."""
    shutil.copytree(shapes, folder)
    file = folder / "annotations" / "instances_train.json"
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize("mark", [1, 3, 6])
def test_an_orientation_mark_changes_no_score(shapes: Path, tmp_path: Path, mark: int) -> None:
    def as_jpeg(content: dict[str, Any]) -> None:
        for entry in content["images"]:
            picture = tmp_path / "data" / "train" / entry["file_name"]
            data = bytes(cv2.imencode(".jpg", cv2.imread(str(picture)), [cv2.IMWRITE_JPEG_QUALITY, 95])[1])
            entry["file_name"] = picture.with_suffix(".jpg").name
            picture.with_suffix(".jpg").write_bytes(with_orientation(data, mark))

    folder = coco_copy(shapes, tmp_path / "data", as_jpeg)
    data = load_coco(folder, "train")
    image, found = read_marked_picture(data.pictures[0])
    assert found == mark
    disc = image[mask_of(data.pictures[0].instances[0], data.pictures[0])]
    np.testing.assert_allclose(disc.mean(axis=0), (220, 30, 30), atol=12)  # where it is annotated
    scores = evaluate_detector(Perfect(folder), data)
    assert scores.boxes.values == pytest.approx((1, 1, 1, 1))
    assert scores.marked == (12 if mark > 1 else 0)


def test_images_listed_as_turned_are_refused_with_the_rule(shapes: Path, tmp_path: Path) -> None:
    def turn(content: dict[str, Any]) -> None:
        entry = content["images"][0]
        picture = tmp_path / "data" / "train" / entry["file_name"]
        data = bytes(cv2.imencode(".jpg", cv2.imread(str(picture)))[1])
        picture.write_bytes(with_orientation(data, 6))
        entry["width"], entry["height"] = entry["height"], entry["width"]

    data = load_coco(coco_copy(shapes, tmp_path / "data", turn), "train")
    with pytest.raises(TrainingError, match="64x48, but its entry says 48x64: it has an orientation mark, which semdb"):
        read_picture(data.pictures[0])


def test_a_set_without_annotations_is_said(shapes: Path, tmp_path: Path) -> None:
    data = load_coco(coco_copy(shapes, tmp_path / "data", lambda content: content["annotations"].clear()), "train")
    with pytest.raises(TrainingError, match=r"has no annotation of the classes disc, square in its 12 images"):
        evaluate_detector(Perfect(shapes), data)


def test_images_listed_twice_are_said(shapes: Path, tmp_path: Path) -> None:
    def double(content: dict[str, Any]) -> None:
        content["images"].append(dict(content["images"][0]))
        content["images"].append(content["images"][1] | {"id": 999})

    data = load_coco(coco_copy(shapes, tmp_path / "data", double), "train")
    assert len(data.pictures) == 13
    twice, several = data.notes
    assert "1 image(s) are listed twice; the first entry of each id is kept" in twice
    assert "1 image file(s) are listed under several ids" in several
    assert load_coco(shapes, "train").notes == ()


def test_classes_listed_twice_or_not_at_all_are_said(shapes: Path, tmp_path: Path) -> None:
    def change(content: dict[str, Any]) -> None:
        content["categories"].append(content["categories"][0] | {"id": 50})
        content["annotations"][0]["category_id"] = 50
        content["annotations"][1]["category_id"] = 777

    data = load_coco(coco_copy(shapes, tmp_path / "data", change), "train")
    assert sum(len(picture.instances) for picture in data.pictures) == 23
    assert "a class is listed more than once" in data.notes[0]
    assert "1 annotation(s) of classes that are not listed are left out" in data.notes[1]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_annotations_in_other_encodings(shapes: Path, tmp_path: Path, encoding: str) -> None:
    folder = coco_copy(shapes, tmp_path / "data", lambda content: None)
    file = folder / "annotations" / "instances_train.json"
    file.write_text(file.read_text(), encoding=encoding)
    assert len(load_coco(folder, "train").pictures) == 12


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 100_000, "nested too deeply"),
        ('{"images": [{"id": 1e999}]}', "a number that is too large"),
        ('{"images": [{"id": Infinity}], "annotations": [], "categories": []}', "not in COCO's format"),
    ],
)
def test_broken_annotations_are_one_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "annotations").mkdir()
    (tmp_path / "train").mkdir()
    (tmp_path / "annotations" / "instances_train.json").write_text(text)
    with pytest.raises(TrainingError, match=message) as caught:
        load_coco(tmp_path, "train")
    assert len(str(caught.value)) < 400
